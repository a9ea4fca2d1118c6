"""The one door: `ash-bench VERB`. A verb's module is imported when it is asked for, and what is heavy when it works."""

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

from ash.fields import nearest
from ash.files import InputError, disk_problem
from benchmarks.verbs.arguments import DONE, INTERRUPTED, WRONG_INPUT, Verb, completion, own_name, read_verb

VERBS = {
    "run": "runs:Run",
    "suites": "checkout:Suites",
    "synth": "captures:Synth",
    "train": "runs:Train",
    "report": "runs:Report",
    "compare": "runs:Compare",
    "eval": "runs:Eval",
    "rescore": "runs:Rescore",
    "merge": "runs:Merge",
    "verify": "captures:Verify",
    "export": "captures:Export",
    "undistort": "captures:Undistort",
    "motions": "captures:Motions",
    "sheets": "captures:Sheets",
    "check-method": "methods:CheckMethod",
    "search": "methods:Search",
    "retarget": "methods:Retarget",
    "display": "methods:Display",
    "play": "avatars:Play",
    "video": "avatars:Video",
    "export-avatar": "avatars:ExportAvatar",
    "share": "avatars:SharePage",
    "gate": "gate:Gate",
    "gate-rates": "gate:GateRates",
    "speed": "checkout:Speed",
    "doctor": "checkout:Doctor",
    "docs": "checkout:Docs",
    "test": "checkout:Test",
}

HELP = """\
usage: {name} VERB ...

Judge animatable human avatars (ASH and its competitors) against exactly known ground truth:
render a synthetic human, train every method on it, and report how accurate and how fast each one is.

{verbs}

`{name} VERB --help` tells what a verb takes.

examples:
  {name} run                  the main comparison; ends with runs/quick/report.html
  {name} run ci               the same machinery, small, in about a minute
  {name} run quick --seeds 3  with error bars
  {name} run my.toml          your scenes, methods and ablations; `{name} suites` prints ours as a start
  {name} train ash data/mannequin-ci-0 --preset ci
  {name} doctor               what this machine has, and what follows from it

completion in bash (zsh, fish and tcsh likewise):
  {name} --tyro-print-completion bash > ~/.local/share/bash-completion/completions/ash-bench

exit codes: 0 done, 1 a cell or check failed, 2 wrong input, 130 interrupted (the same command goes on)"""


def main(argv: list[str] | None = None) -> int:
    """Run a verb and return the exit code."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # As cells run; read when torch and FLIP are loaded, so set it first.
    try:
        with _terminate_as_interrupt():
            verb = _parse(sys.argv[1:] if argv is None else argv)
            return DONE if verb is None else verb()
    except InputError as error:
        return _refuse(str(error))
    except BrokenPipeError:  # Whoever read our output has seen enough (`| head`).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        line = disk_problem(error)
        if line is None:
            raise
        return _refuse(line)
    except KeyboardInterrupt:
        print("\nash-bench: interrupted; the same command goes on where it was", file=sys.stderr)
        return INTERRUPTED


def _parse(tokens: Sequence[str]) -> Verb | None:
    """The verb that is asked for; None where it was help, which is printed."""
    if not tokens:
        raise InputError(f"expected a verb, see {own_name()} --help")
    first = tokens[0]
    if first in ("-h", "--help"):
        print(_help())
        return None
    if first.startswith("--tyro-"):
        completion({name: _verb(name) for name in VERBS}, tokens)
    if first not in VERBS:
        raise InputError(f"unknown verb {first!r}, {nearest(first, tuple(VERBS))}")
    return read_verb(_verb(first), first, tokens[1:])


def _verb(name: str) -> type[Any]:
    module, _, verb = VERBS[name].partition(":")
    found: type[Any] = getattr(import_module(f"benchmarks.verbs.{module}"), verb)
    return found


def _help() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {(_verb(name).__doc__ or '').splitlines()[0].rstrip('.')}" for name in VERBS]
    return HELP.format(name=own_name(), verbs="\n".join(lines))


def _refuse(line: str) -> int:
    print(f"ash-bench: {line}", file=sys.stderr)
    return WRONG_INPUT


@contextlib.contextmanager
def _terminate_as_interrupt() -> Any:
    """Treat a polite request to end (a scheduler's SIGTERM) like Ctrl-C."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


if __name__ == "__main__":
    sys.exit(main())
