import re
import subprocess
import sys

import pytest
from helpers.commands import refused

from benchmarks import cli
from benchmarks.commands import arguments

pytestmark = pytest.mark.usefixtures("installed_fakes")


def test_help_lists_every_command_and_how_to_go_on(capsys) -> None:
    assert cli.main(["--help"]) == arguments.DONE
    told = capsys.readouterr().out
    listed = dict(re.findall(r"^  ([a-z][a-z-]*)  +([A-Z].*)$", told, re.MULTILINE))
    assert listed == {
        command: (cli._command(command).__doc__ or "").splitlines()[0].rstrip(".") for command in cli.COMMANDS
    }
    assert f"{arguments.own_name()} run my.toml" in told


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_says_what_every_argument_is(command: str) -> None:
    flags = list(arguments._flags_of(cli._command(command)))
    assert [flag.name for flag in flags if not flag.about] == []


def test_a_commands_help_needs_nothing_heavy() -> None:
    code = """
import sys
from benchmarks.cli import COMMANDS, main
for command in COMMANDS:
    try:
        main([command, "--help"])
    except SystemExit as end:
        assert end.code == 0, command
    heavy = {"torch", "mitsuba", "pandas", "altair", "scipy", "matplotlib"} & set(sys.modules)
    assert not heavy, (command, heavy)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [command for command in cli.COMMANDS if f"ash-bench {command}" not in done.stdout] == []


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "expected a command"),
        ("rn", "unknown command 'rn', did you mean run"),
        ("run --seeds 0", "--seeds: expected at least 1, got 0"),
        ("run ci --subjects 101", "subjects: expected 1 to 100, got 101: those from 100 on are for validation"),
        ("synth loose --subject -1", "--subject: expected at least 0, got -1"),
        ("train ash x --seed 18446744073709551616", "--seed: expected at most 2147483647, got 18446744073709551616"),
        ("report --out x", "expected"),
        ("run --workers x", "--workers: expected a whole number, got 'x'"),
        ("run --sedes 3", "unknown option '--sedes', did you mean --seeds"),
        ("run ci extra", "unexpected 'extra'"),
        ("run --scenes nosuch", "unknown scene 'nosuch', expected one of mannequin, "),
        ("run --methods nosuch", "unknown method 'nosuch', expected one of"),
        ("run --size huge --dry-run", "unknown size 'huge', expected one of ci, factor, quick, long, table, paper"),
        ("speed else", "WHAT: expected one of kernels, frame, got 'else'"),
        ("verify", "expected SOURCE"),
        ("export", "expected SOURCE and --format"),
        ("run qiuck --list", "unknown suite 'qiuck', did you mean quick"),
        ("run nosuch", "unknown suite 'nosuch', expected one of budget, cameras, ci, factors, "),
        ("train nosuch x", "unknown method 'nosuch', expected one of"),
        ("synth tihgt", "unknown scene 'tihgt', did you mean tight"),
        ("synth mannequin --rig.camers 24", "unknown option '--rig.camers', did you mean --rig.cameras"),
        ("synth mannequin --rig.cameras many", "--rig.cameras: expected a whole number, got 'many'"),
        ("synth mannequin --size ci --rig.cameras 2000", "held out, expected 1 to all but one"),
        ("train ash nowhere --model.texel 3", "unknown option '--model.texel', did you mean --model.texels"),
        ("train ash nowhere --model.texels 3", "texels: expected a multiple of shuffle"),
        ("train nearest nowhere --model.texels 3", "unknown option '--model.texels', expected one of --preset"),
        ("train ash nowhere --preset chaep", "preset: expected one of ci, brief, cpu"),
    ],
)
def test_wrong_use_is_one_line_and_exits_with_2(command: str, message: str, capsys) -> None:
    assert message in refused(capsys, *command.split())


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("synth", ["--seed"]),
        ("synth mannequin", ["--rig.cameras"]),
        ("train ash", ["--model.texels"]),
        ("train fake_tuned", ["--detail FLOAT", "(default: 0.9)", "--shift-m"]),
    ],
)
def test_help_on_a_scene_and_on_a_method_lists_their_fields(command: str, told: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main([*command.split(), "--help"])
    assert end.value.code == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert [part for part in told if part not in printed] == []
