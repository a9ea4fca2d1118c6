#!/bin/sh
# Run a command where the kernel refuses user namespaces, as Docker does with its default settings: in a chroot of the
# same files. Needs root. usage: without_namespaces.sh COMMAND [ARG ...]
set -eu
exec unshare --mount sh -c '
    here=$1; shift
    root=$(mktemp -d)
    mount --rbind / "$root"
    mount --make-rslave "$root"
    exec chroot "$root" sh -c "cd \"\$0\" && exec \"\$@\"" "$here" "$@"
' sh "$PWD" "$@"
