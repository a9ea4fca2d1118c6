"""How a command line becomes a command: frozen dataclasses whose fields are arguments, read by tyro.

A command is a frozen dataclass that is called to do its work and returns an exit code. A command about a scene's or a
method's configuration has the method `settings`, which returns that: then each of its fields is a flag as well.
"""

import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import tyro
from tyro import _docstrings, _errors
from tyro.conf import (
    DisallowNone,
    FlagConversionOff,
    FlagCreatePairsOff,
    Positional,
    PositionalMetavarFromFieldName,
    arg,
)
from tyro.constructors import PrimitiveConstructorSpec

from ash.fields import Changes, changed, flat, suggest
from ash.files import InputError
from benchmarks.aliases import OLD_FIELDS, OLD_SIZES

Command = Callable[[], int]  # Does its work, and returns the exit code.
DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
SHELLS = ("bash", "zsh", "fish", "tcsh")
MARKERS = (PositionalMetavarFromFieldName, DisallowNone)
POSITIONAL = Positional[str].__metadata__[0]  # type: ignore[attr-defined]
SETTINGS = "settings_"  # The field of a command that holds a configuration.

_typed: list[str] = []


def _whole(least: int, most: int | None = None) -> PrimitiveConstructorSpec[Any]:
    def read(texts: list[str]) -> int:
        if not re.fullmatch(r"[+-]?\d+", texts[0]):
            raise ValueError(f"expected a whole number, got {texts[0]!r}")
        if int(texts[0]) < least:
            raise ValueError(f"expected at least {least}, got {texts[0]}")
        if most is not None and int(texts[0]) > most:
            raise ValueError(f"expected at most {most}, got {texts[0]}")
        return int(texts[0])

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="N",
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    )


def _names() -> PrimitiveConstructorSpec[tuple[str, ...]]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="A,B",
        instance_from_str=lambda texts: tuple(name.strip() for name in texts[0].split(",") if name.strip()),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(value)],
    )


Natural = Annotated[int, _whole(0)]
Seed = Annotated[int, _whole(0, 2**31 - 1)]
Count = Annotated[int, _whole(1)]
CountIfAny = Annotated[int | None, _whole(1)]
Names = Annotated[tuple[str, ...], _names()]  # Separated by commas.
Trust = FlagCreatePairsOff[bool]  # Whether code of others is loaded into this process.
Folder = Annotated[Path, arg(metavar="DIR")]
File = Annotated[Path, arg(metavar="FILE")]


def own_name() -> str:
    """What a user of this environment types: the launcher of the checkout it belongs to, or the installed script."""
    launcher = Path(sys.prefix).parent / "ash-bench"
    return "./ash-bench" if Path(sys.prefix).name == ".venv" and launcher.is_file() else "ash-bench"


def typed() -> str:
    """The command as it was given, for reports."""
    return shlex.join([own_name(), *_typed])


def read_command(command: type[Any], name: str, tokens: Sequence[str]) -> Command:
    """The command with the arguments of a command line. Asked for help, it prints that and ends the process.

    Raises:
        InputError: an argument is missing, unknown or wrong; one line, with the nearest names.
    """
    _typed[:] = [name, *tokens]
    wanted, config = command, None
    if hasattr(command, "settings"):
        known = _as_far_as_known(command, name, tokens)
        config = None if known is None else known.settings()
        wanted = command if config is None else _with_settings(command, config)
    flags = _flags(command, config)
    return cast(Command, _read(wanted, f"{own_name()} {name}", _current_tokens(tokens, flags), flags))


def _current_tokens(tokens: Sequence[str], flags: tuple[str, ...]) -> list[str]:
    current = [_current_flag(token, flags) for token in tokens]
    return [
        OLD_SIZES.get(t, t) if before == "--size" else t for before, t in zip(["", *current], current, strict=False)
    ]


def _current_flag(token: str, flags: tuple[str, ...]) -> str:
    """The token, by today's name where it is an old flag of a configuration (`benchmarks.aliases`)."""
    flag, equals, value = token.partition("=")
    new = "--" + OLD_FIELDS.get(flag[2:].replace("-", "_"), "").replace("_", "-")
    return f"{new}{equals}{value}" if flag.startswith("--") and new in flags else token


def changes_of(command: Any) -> Changes:
    """What the command line changed in the configuration that the command is about."""
    settings = getattr(command, SETTINGS, None)
    return () if settings is None else changed(type(settings)(), settings)


def completion(commands: dict[str, type[Any]], tokens: Sequence[str]) -> None:
    """Print a script that completes commands and flags in a shell (`--tyro-print-completion bash`), and end."""
    if len(tokens) < 2 or tokens[1] not in SHELLS:
        raise InputError(f"{tokens[0]}: expected one of {', '.join(SHELLS)}")
    tyro.extras.subcommand_cli_from_dict(cast(Any, commands), prog="ash-bench", args=list(tokens), config=MARKERS)


def _with_settings(command: type[Any], config: Any) -> type[Any]:
    """The command with the configuration's fields as further flags; those that the command has itself stay its own."""
    own = {f.name for f in fields(command)}
    flags: list[Any] = []
    for f in fields(config):
        if f.init and f.name not in own:
            about = _docstrings.get_field_docstring(type(config), f.name, ())
            flags.append((f.name, Annotated[f.type, arg(help=about or "")], field(default=getattr(config, f.name))))
    settings = make_dataclass(type(config).__name__, flags, frozen=True, kw_only=True)
    settings.__doc__ = (type(config).__doc__ or "").splitlines()[0] or None
    where = FlagConversionOff[Annotated[settings, arg(name="", prefix_name=False)]]  # type: ignore[valid-type]
    return make_dataclass(
        command.__name__,
        [(SETTINGS, where, field(default=settings()))],
        bases=(command,),
        frozen=True,
        kw_only=True,
        namespace={"__doc__": command.__doc__},
    )


def _as_far_as_known(command: type[Any], name: str, tokens: Sequence[str]) -> Any:
    """The command without what belongs to a configuration, or None where even its own arguments are incomplete."""
    known = _flags(command, None)
    kept: list[str] = []
    waiting = iter(range(len(tokens)))
    for index in waiting:
        token = tokens[index]
        flag = token.partition("=")[0].replace("_", "-")
        if token in ("-h", "--help"):
            continue
        if token.startswith("--") and flag not in known:
            if "=" not in token and index + 1 < len(tokens) and not tokens[index + 1].startswith("--"):
                next(waiting, None)
            continue
        kept.append(token)
    helped = any(token in ("-h", "--help") for token in tokens) and kept[:1] and not kept[0].startswith("-")
    for missing in ([], ["."]) if helped else ([],):  # Help on a method needs no capture.
        try:
            with _errors.on_parse_error(_stop):
                return tyro.cli(command, prog=name, args=[*kept, *missing], config=MARKERS, return_unknown_args=True)[0]
        except _StoppedError:
            continue
    return None


class _StoppedError(Exception):
    pass


def _stop(event: Any) -> None:
    raise _StoppedError


def _read(command: type[Any], prog: str, tokens: Sequence[str], known: tuple[str, ...]) -> Any:
    def refuse(event: _errors.ParseErrorEvent) -> None:
        raise InputError(_problem(event, known))

    with _errors.on_parse_error(refuse):
        return tyro.cli(command, prog=prog, args=list(tokens), config=MARKERS)


def _flags(command: type[Any], config: Any) -> tuple[str, ...]:
    """Every flag that there is, as it is typed."""
    names = []
    for f in fields(command):
        marks = getattr(f.type, "__metadata__", ())
        if is_dataclass(f.default):
            names += [key.name for key in fields(f.default)]
        elif POSITIONAL not in marks:
            names.append(next((mark.name for mark in marks if getattr(mark, "name", None)), f.name))
    keys = () if config is None else tuple(key for key in flat(config) if key not in names)
    return tuple(f"--{key.replace('_', '-')}" for key in (*names, *keys))


def _problem(event: _errors.ParseErrorEvent, known: tuple[str, ...]) -> str:
    """A parser's complaint in one line."""
    if isinstance(event, _errors.UnrecognizedArgs):
        return _unknown(event.tokens, known)
    if isinstance(event, _errors.MissingArgs):
        if event.unrecognized_tokens and event.unrecognized_tokens[0].startswith("-"):
            return _unknown(event.unrecognized_tokens, known)
        return f"expected {' and '.join(_name(each.arg) for each in event.missing_arguments)} (--help says more)"
    if isinstance(event, _errors.InvalidChoice):
        return f"{_name(event.argument)}: expected one of {', '.join(event.choices)}, got {event.value!r}"
    if isinstance(event, _errors.BadValue):
        return f"{_name(event.argument)}: expected a value"
    if isinstance(event, _errors.InstantiationFailure):
        about = _plain(event.message)
        return about if event.argument is None else f"{_name(event.argument)}: {about}"
    return f"wrong arguments ({type(event).__name__}); --help says more"


def _unknown(tokens: Sequence[str], known: tuple[str, ...]) -> str:
    flag = tokens[0].partition("=")[0].replace("_", "-")
    return f"unknown option {flag!r}, {suggest(flag, known)}" if flag.startswith("-") else f"unexpected {tokens[0]!r}"


def _name(argument: Any) -> str:
    return str(argument.lowered.metavar if argument.is_positional() else argument.lowered.name_or_flags[-1])


def _plain(message: Any) -> str:
    return " ".join((message if isinstance(message, str) else str(message)).split())
