"""Which failures of the system are the user's to mend: said in one line, exit code 2."""

import errno

MENDABLE = {
    errno.ENOSPC: "no space left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file would be larger than the system allows",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
    errno.ENOTDIR: "a part of the path is a file, expected a folder",
    errno.EEXIST: "expected a folder, got a file",
    errno.EISDIR: "expected a file, got a folder",
    errno.ENOENT: "no such file or folder",
    errno.ENAMETOOLONG: "the name is too long",
}


def disk_problem(error: OSError) -> str | None:
    """One line about an error of the file system that a user can mend, or None for any other error."""
    if error.errno not in MENDABLE:
        return None
    where = error.filename2 or error.filename
    return f"{where}: {MENDABLE[error.errno]}" if where else MENDABLE[error.errno]
