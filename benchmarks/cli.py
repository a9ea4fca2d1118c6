"""The command line: `ash-bench COMMAND`. A command's module is imported on demand, heavy packages when it runs."""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

# How often an idle thread of OpenMP looks for work before it sleeps: for the time between two operations. By itself the
# runtime looks 300,000 times, for 20 ms: whatever else has work for that core waits, at times the team's own thread.
SPINS = "1000"


def _set_threads() -> None:
    """Settle how many threads OpenMP and BLAS have and how they wait, unless the user did."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # As cells run.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


# No child imports from the folder where the user stands: a `random.py` there would replace Python's own.
os.environ["PYTHONSAFEPATH"] = "1"
_set_threads()  # Read as NumPy, torch and FLIP are loaded, the first of them by the imports below.

from ash.fields import suggest
from ash.files import InputError, disk_problem
from benchmarks.aliases import OLD_COMMANDS
from benchmarks.cell.sandbox import METHOD_PATH, add_method_paths
from benchmarks.commands.arguments import DONE, INTERRUPTED, WRONG_INPUT, Command, own_name, read_command

METHOD_PATH_FLAG = "--method-path"

COMMANDS = {
    "run": "runs:RunCommand",
    "synth": "captures:SynthCommand",
    "import": "captures:ImportCommand",
    "train": "runs:TrainCommand",
    "report": "runs:ReportCommand",
    "compare": "runs:CompareCommand",
    "claims": "runs:ClaimsCommand",
    "eval": "runs:EvalCommand",
    "score": "runs:ScoreCommand",
    "pack": "sharing:PackCommand",
    "verify": "captures:VerifyCommand",
    "leaderboard": "sharing:LeaderboardCommand",
    "motions": "captures:MotionsCommand",
    "check-method": "methods:CheckMethodCommand",
    "play": "avatars:PlayCommand",
    "export": "avatars:ExportCommand",
    "gate": "gate:GateCommand",
    "speed": "checkout:SpeedCommand",
    "doctor": "checkout:DoctorCommand",
    "test": "checkout:TestCommand",
}

HELP = Path(__file__).with_name("help.txt")  # Also printed by the launcher, which then needs no set-up.


def main(argv: list[str] | None = None) -> int:
    """Run a command and return the exit code."""
    _open_closed_streams()
    try:
        with _terminate_as_interrupt():
            command = _parse(_take_method_paths(sys.argv[1:] if argv is None else argv))
            return DONE if command is None else command()
    except InputError as error:
        return _refuse(str(error))
    except BrokenPipeError:  # Whoever read our output has seen enough (`| head`).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        line = _semaphore_problem(error) or disk_problem(error)
        if line is None:
            raise
        return _refuse(line)
    except Exception as error:
        line = _cell_problem(error)
        if line is None:
            raise
        return _refuse(line)
    except KeyboardInterrupt:
        print("\nash-bench: interrupted; the same command goes on where it was", file=sys.stderr)
        return INTERRUPTED


def _take_method_paths(tokens: Sequence[str]) -> list[str]:
    """The command line without `--method-path DIR`, whose folders are searched for methods, here and in children."""
    left, folders = [], []
    waiting = iter(tokens)
    for token in waiting:
        flag, given, value = token.partition("=")
        if flag != METHOD_PATH_FLAG:
            left.append(token)
            continue
        folder = value if given else next(waiting, "")
        if not folder or not Path(folder).is_dir():
            raise InputError(f"{METHOD_PATH_FLAG}: expected a folder, got {folder!r}")
        folders.append(str(Path(folder).resolve()))
    if folders:
        before = os.environ.get(METHOD_PATH)
        os.environ[METHOD_PATH] = os.pathsep.join([*([before] if before else []), *folders])
    add_method_paths()
    return left


def _open_closed_streams() -> None:
    """Give closed standard streams to nobody: else the next file that is opened would be printed into."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # The lowest that is free: this one.
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(descriptor, "r" if name == "stdin" else "w", closefd=False))


def _semaphore_problem(error: OSError) -> str | None:
    """What processes that work side by side need, and this system does not give: an error that names no file."""
    if error.filename is not None:
        return None
    try:
        multiprocessing.get_context("spawn").Lock()
    except OSError as refused:
        return f"/dev/shm: cannot be used for what processes share ({refused.strerror}); it wants to be writable"
    return None


def _cell_problem(error: Exception) -> str | None:
    """What ended a cell that a command runs in its own process, and is not the method's fault."""
    from benchmarks.cell.schema import HarnessFailed, Killed

    reason = str(error) or "the method's process was killed from outside"
    return reason if isinstance(error, (HarnessFailed, Killed)) else None


def _parse(tokens: Sequence[str]) -> Command | None:
    """The command that is asked for; None where it was help, which is printed."""
    if not tokens:
        raise InputError(f"expected a command, see {own_name()} --help")
    first = tokens[0]
    if first in OLD_COMMANDS:
        print(f"ash-bench: {first} is now: {' '.join(OLD_COMMANDS[first])}", file=sys.stderr)
        tokens = (*OLD_COMMANDS[first], *tokens[1:])
        first = tokens[0]
    if first in ("-h", "--help"):
        print(HELP.read_text().replace("{name}", own_name()), end="")
        return None
    if first == "--version":
        print(f"ash-bench {version('ash-bench')}")
        return None
    if first not in COMMANDS:
        raise InputError(f"unknown command {first!r}, {suggest(first, tuple(COMMANDS))}")
    return read_command(_command(first), first, tokens[1:])


def _command(name: str) -> type[Any]:
    module, _, command = COMMANDS[name].partition(":")
    kind: type[Any] = getattr(import_module(f"benchmarks.commands.{module}"), command)
    return kind


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
