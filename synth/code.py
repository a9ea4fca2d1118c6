"""Which code makes captures: a capture made by other code is made again, never reused."""

import hashlib
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# What reads captures and decides no byte of them. Everything else in this folder counts as making them.
READERS = ("export", "official", "perturb", "retargeting", "sheets", "truth", "undistorting")
FORMATS = ("dataset.py", "files.py", "lens.py")  # of the package ash
PACKAGES = ("anny", "drjit", "mitsuba", "numpy", "pillow", "scipy")


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of what decides the bytes of a capture: our sources, and the versions of what they rely on."""
    versions = [f"{package} {_version(package)}" for package in PACKAGES]
    return hashlib.sha256("\n".join([source_version(), *versions]).encode()).hexdigest()[:16]


@lru_cache(maxsize=1)
def source_version() -> str:
    """Hash of our sources alone: equal on machines whose renders differ by rounding."""
    digest = hashlib.sha256()
    for path in maker_sources():
        digest.update(f"{path.name} {len(path.read_bytes())}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def maker_sources() -> list[Path]:
    """The files of source that decide the bytes of a capture."""
    here = Path(__file__).parent
    own = [path for path in sorted(here.glob("*.py")) if path.stem not in READERS]
    return own + [here.parent / "ash" / name for name in FORMATS]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"
