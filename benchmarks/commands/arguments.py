"""How a command line becomes a command: frozen dataclasses whose fields are arguments, read by argparse.

A command is a frozen dataclass that is called to do its work and returns an exit code. The comment beside a field is
its help. A command about a scene's or a method's configuration has the method `settings`, which returns that, and a
field `changes`: then each field of the configuration is a flag as well (`--model.texels 128`).
"""

import argparse
import inspect
import re
import shlex
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from ash.fields import Leaf, apply_overrides, changed, leaves, suggest
from ash.files import InputError
from benchmarks.aliases import OLD_FIELDS, OLD_SIZES
from benchmarks.problems import Problems

Command = Callable[[], int]  # Does its work, and returns the exit code.
DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
HELP = ("-h", "--help")
T = TypeVar("T")

_typed: list[str] = []


@dataclass(frozen=True, slots=True)
class Argument:
    """How a field is read and shown, where its type does not say it; a part of `Annotated`."""

    metavar: str = ""
    name: str = ""  # of the flag, where it is not the field's
    read: Callable[[str], Any] | None = None
    positional: bool = False
    repeated: bool = False  # each time that the flag is given adds a value


def whole(least: int, most: int | None = None) -> Argument:
    """A whole number in a range."""

    def read(text: str) -> int:
        number = _whole_number(text)
        if number < least:
            raise ValueError(f"expected at least {least}, got {text}")
        if most is not None and number > most:
            raise ValueError(f"expected at most {most}, got {text}")
        return number

    return Argument(metavar="N", read=read)


def _whole_number(text: str) -> int:
    if not re.fullmatch(r"[+-]?\d+", text):
        raise ValueError(f"expected a whole number, got {text!r}")
    return int(text)


def _real_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"expected a number, got {text!r}") from None


def _truth(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(f"expected True or False, got {text!r}")
    return text.lower() == "true"


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


READ: dict[Any, Callable[[str], Any]] = {int: _whole_number, float: _real_number, bool: _truth, str: str, Path: Path}
Positional = Annotated[T, Argument(positional=True)]
Repeated = Annotated[T, Argument(repeated=True)]
Natural = Annotated[int, whole(0)]
Seed = Annotated[int, whole(0, 2**31 - 1)]
Count = Annotated[int, whole(1)]
Names = Annotated[tuple[str, ...], Argument(metavar="A,B", read=_names)]
Folder = Annotated[Path, Argument(metavar="DIR")]
File = Annotated[Path, Argument(metavar="FILE")]


def refuse_all(problems: Problems) -> int:
    """Print every problem in a line of its own; returns the exit code."""
    for line in problems.lines:
        print(f"ash-bench: {line}", file=sys.stderr)
    return WRONG_INPUT


def own_name() -> str:
    """What a user of this environment types: the launcher of the checkout it belongs to, or the installed script."""
    launcher = Path(sys.prefix).parent / "ash-bench"
    return "./ash-bench" if Path(sys.prefix).name == ".venv" and launcher.is_file() else "ash-bench"


def typed() -> str:
    """The command as it was given, for reports."""
    return shlex.join([own_name(), *_typed])


@dataclass(frozen=True, slots=True)
class _Flag:
    """An argument as argparse is to have it."""

    key: str  # of its value: dotted, of a field of the configuration
    kind: Any  # its type; of several values, that of one
    about: str
    default: Any
    argument: Argument
    several: bool = False  # all values that follow the flag
    switch: bool = False  # given or not; takes no value

    @property
    def name(self) -> str:
        """As it is typed."""
        name = self.argument.name or self.key
        return name.upper() if self.argument.positional else f"--{name.replace('_', '-')}"

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Give it to the parser."""
        options: dict[str, Any] = {"help": self.help().replace("%", "%%"), "default": argparse.SUPPRESS}
        if self.switch:
            parser.add_argument(self.name, dest=self.key, action="store_true", **options)
            return
        options |= {"type": self.read, "metavar": self.argument.metavar or _metavar(self.kind)}
        if self.argument.positional:
            many = "*" if self.several else "?"
            parser.add_argument(self.key, **options | {"default": None, "metavar": self.name, "nargs": many})
            return
        if self.argument.repeated:
            options["action"] = "append"
        elif self.several:
            options["nargs"] = "*"
        parser.add_argument(self.name, dest=self.key, **options)

    def read(self, text: str) -> Any:
        """A value from what was typed."""
        try:
            if get_origin(self.kind) is Literal and text not in get_args(self.kind):
                raise ValueError(f"expected one of {', '.join(get_args(self.kind))}, got {text!r}")
            return (self.argument.read or READ.get(self.kind, str))(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(" ".join(str(error).split())) from error

    def help(self) -> str:
        """What the comment says, and the default."""
        if self.default is MISSING:
            return f"{self.about} (required)".strip()
        plain = self.default in (None, (), "") or self.switch
        return self.about if plain else f"{self.about} (default: {self.default})".strip()


def read_command(command: type[Any], name: str, tokens: Sequence[str]) -> Command:
    """The command with the arguments of a command line. Asked for help, it prints that and ends the process.

    Raises:
        InputError: an argument is missing, unknown or wrong; one line, with the nearest names.
    """
    _typed[:] = [name, *tokens]
    own = list(_flags_of(command))
    config = _config_of(command, name, own, tokens) if hasattr(command, "settings") else None
    further = [] if config is None else _flags_of_config(config, {flag.key for flag in own})
    values = _parse(command, name, [*own, *further], _current_tokens(tokens, [*own, *further]))
    made = _made(command, values)
    if config is None:
        return cast(Command, made)
    keys = {flag.key for flag in further}
    given = {key: value for key, value in values.items() if key in keys}
    try:
        varied = apply_overrides(config, given, of=name)
    except ValueError as error:  # Of a method's own configuration.
        raise InputError(str(error)) from error
    return cast(Command, _made(command, values | {"changes": changed(config, varied)}))


def _parse(command: type[Any], name: str, flags: Sequence[_Flag], tokens: Sequence[str]) -> dict[str, Any]:
    names = tuple(flag.name for flag in flags if not flag.argument.positional)
    end = tokens.index("--") if "--" in tokens else len(tokens)
    joined, after = _joined(tokens[:end], flags), tokens[end + 1 :]
    for token in joined:
        head = token.partition("=")[0]
        if token.startswith("--") and head not in (*names, *HELP):
            raise InputError(f"unknown option {head!r}, {suggest(head, names)}")
    positional = [flag.name for flag in flags if flag.argument.positional]
    parser = argparse.ArgumentParser(
        prog=f"{own_name()} {name}",
        usage=" ".join(["%(prog)s [OPTIONS]", *positional]),
        description=inspect.cleandoc(command.__doc__ or ""),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        exit_on_error=False,
    )
    for flag in flags:
        flag.add_to(parser)
    try:
        values, rest = parser.parse_known_intermixed_args(joined)
    except argparse.ArgumentError as error:
        of = next((flag.name for flag in flags if error.argument_name in (flag.name, flag.key)), error.argument_name)
        expected = "expected a value" if error.message.startswith("expected") and "argument" in error.message else ""
        raise InputError(f"{of}: {expected or error.message}") from error
    given = {key: value for key, value in vars(values).items() if value is not None}
    missing = [flag.name for flag in flags if flag.default is MISSING and not given.get(flag.key)]
    if missing and not after:
        raise InputError(f"expected {' and '.join(missing)} (--help says more)")
    if rest:
        raise InputError(f"unexpected {rest[0]!r}")
    several = [flag.key for flag in flags if flag.several or flag.argument.repeated]
    taker = next((flag.key for flag in flags if flag.argument.positional and flag.several), None)
    if after and taker is None:
        raise InputError(f"unexpected {after[0]!r}")
    if after and taker is not None:
        given[taker] = [*given.get(taker, ()), *after]
    return {key: tuple(value) if key in several else value for key, value in given.items()}


def _joined(tokens: Sequence[str], flags: Sequence[_Flag]) -> list[str]:
    """Flags by their names, each with its value in one token: a value may then begin with a minus."""
    single = {flag.name for flag in flags if not (flag.switch or flag.several or flag.argument.positional)}
    joined: list[str] = []
    for token in tokens:
        head, equals, value = token.partition("=")
        if joined and joined[-1] in single and not token.startswith("--"):
            joined[-1] = f"{joined[-1]}={token}"
        elif token.startswith("--"):
            joined.append(f"{head.replace('_', '-')}{equals}{value}")
        else:
            joined.append(token)
    return joined


def _made(command: type[Any], values: dict[str, Any]) -> Any:
    """The dataclass from the values of its fields, and of those within it."""
    hints, given = get_type_hints(command), {}
    for field in fields(command):
        if is_dataclass(hints[field.name]):
            given[field.name] = _made(cast(type[Any], hints[field.name]), values)
        elif field.name in values:
            given[field.name] = values[field.name]
    return command(**given)


def _flags_of(command: type[Any]) -> Iterator[_Flag]:
    """The command's own arguments."""
    comments, hints = field_comments(command), get_type_hints(command, include_extras=True)
    for field in fields(command):
        kind, argument, several = _described(hints[field.name])
        if is_dataclass(kind):
            yield from _flags_of(cast(type[Any], kind))
        elif field.name != "changes":
            about = comments.get(field.name, "")
            yield _Flag(field.name, kind, about, field.default, argument, several, switch=kind is bool)


def _flags_of_config(config: Any, taken: set[str]) -> list[_Flag]:
    """The fields of a configuration; those that the command has itself stay its own."""
    shown = [leaf for leaf in leaves(config) if leaf.key not in taken]
    # Once for each class: Python parses the whole file to find its source.
    comments = {owner: field_comments(owner) for owner in {leaf.owner for leaf in shown}}

    def flag(leaf: Leaf) -> _Flag:
        kind, argument, several = _described(leaf.kind)
        return _Flag(leaf.key, kind, comments[leaf.owner].get(leaf.name, ""), leaf.value, argument, several)

    flags = [flag(leaf) for leaf in shown]
    return [flag for flag in flags if flag.kind in READ or get_origin(flag.kind) is Literal]


def _described(hint: Any) -> tuple[Any, Argument, bool]:
    """The type of a value, how it is read, and whether there are several."""
    argument = Argument()
    while get_origin(hint) in (Annotated, Union, types.UnionType):
        if get_origin(hint) is Annotated:
            hint, argument = get_args(hint)
        else:
            hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is not tuple or argument.read is not None:
        return hint, argument, False
    return get_args(hint)[0], argument, not argument.repeated


def _metavar(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "{" + ",".join(get_args(kind)) + "}"
    return str(getattr(kind, "__name__", "VALUE")).upper()


def field_comments(kind: type[Any]) -> dict[str, str]:
    """The comment of every field of a dataclass: behind it, or in the lines above."""
    comments: dict[str, str] = {}
    for part in reversed(kind.__mro__):
        try:
            source = inspect.getsource(part) if is_dataclass(part) else ""
        except (OSError, TypeError):  # Made without a file.
            continue
        above: list[str] = []
        for line in map(str.strip, source.splitlines()):
            field = re.match(r"(\w+): .*?(?:  # (.*))?$", line)
            if field is not None:
                comments[field[1]] = field[2] or " ".join(above)
            above = [*above, line.lstrip("# ")] if line.startswith("#") else []
    return comments


def _current_tokens(tokens: Sequence[str], flags: Sequence[_Flag]) -> list[str]:
    """Tokens by today's names where they are old flags or sizes (`benchmarks.aliases`)."""
    names, current = {flag.name for flag in flags}, []
    for token in tokens:
        flag, equals, value = token.partition("=")
        new = "--" + OLD_FIELDS.get(flag[2:].replace("-", "_"), "").replace("_", "-")
        renamed = flag.startswith("--") and new in names
        current.append(f"{new}{equals}{value}" if renamed else token)
    return [OLD_SIZES.get(t, t) if flag == "--size" else t for flag, t in zip(["", *current], current, strict=False)]


def _config_of(command: type[Any], name: str, own: Sequence[_Flag], tokens: Sequence[str]) -> Any:
    """The configuration that a command line means, without its flags; None where its own arguments are incomplete.

    Whether a flag of the configuration takes one value or several is known once the configuration is: both are tried.
    """
    helped = any(token in HELP for token in tokens)
    for several in (False, True):
        own_tokens = _own_tokens(own, tokens, several=several)
        named = helped and own_tokens[:1] and not own_tokens[0].startswith("-")
        for missing in ([], ["."]) if named else ([],):  # Help on a method needs no capture.
            try:
                made = _made(command, _parse(command, name, own, _current_tokens([*own_tokens, *missing], own)))
            except InputError:
                continue
            return made.settings()
    return None


def _own_tokens(own: Sequence[_Flag], tokens: Sequence[str], *, several: bool) -> list[str]:
    """Tokens without other flags than a command's own; of those, one value is left out, or all that follow."""
    names = {flag.name for flag in own}
    kept: list[str] = []
    values = 0  # That may still belong to a flag which was left out.
    for token in tokens:
        if token in HELP:
            continue
        if token.startswith("--"):
            is_own = token.partition("=")[0].replace("_", "-") in names
            values = 0 if is_own or "=" in token else len(tokens) if several else 1
            if is_own:
                kept.append(token)
        elif values:
            values -= 1
        else:
            kept.append(token)
    return kept
