"""Old names that users may have typed, accepted for one release: each with what takes its place."""

import sys
from collections.abc import Callable, Sequence

# An old command: the arguments that replace it, or a function from the old arguments to the new command line.
Replacement = list[str] | Callable[[list[str]], list[str]]


def _export_avatar(arguments: list[str]) -> list[str]:
    """`glb` was the format of meshes, which is now `gltf`."""
    return [
        "export",
        *("gltf" if each == "glb" else each.replace("--format=glb", "--format=gltf") for each in arguments),
    ]


COMMANDS: dict[str, Replacement] = {
    "video": ["export", "--format", "mp4"],
    "share": ["export", "--format", "html"],
    "export-avatar": _export_avatar,
}


def current_command(tokens: Sequence[str]) -> list[str]:
    """The command line with an old command replaced, and a line on stderr that says what to type instead."""
    replacement = COMMANDS.get(tokens[0]) if tokens else None
    if replacement is None:
        return list(tokens)
    rest = list(tokens[1:])
    command = replacement(rest) if callable(replacement) else [*replacement, *rest]
    print(f"{tokens[0]}: old name; use {' '.join(command)}", file=sys.stderr)
    return command
