"""Old names of commands and fields, which work for one release."""

import pytest

from ash.presets import named
from benchmarks import cli
from benchmarks.aliases import OLD_COMMANDS, OLD_FIELDS
from benchmarks.cell.registry import configured
from benchmarks.commands.arguments import read_command
from benchmarks.commands.runs import TrainCommand


@pytest.mark.parametrize("old", OLD_COMMANDS)
def test_an_old_command_is_the_new_one_and_says_so(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([old, "--help"])
    printed = capsys.readouterr()
    assert f"{old} is now: {' '.join(OLD_COMMANDS[old])}" in printed.err
    assert f"ash-bench {OLD_COMMANDS[old][0]}" in printed.out


@pytest.mark.parametrize(("old", "new"), OLD_FIELDS.items())
def test_an_old_field_is_read_as_a_flag_and_in_a_suite(old: str, new: str) -> None:
    part, _, field = new.partition(".")
    value = getattr(getattr(named("ci"), part), field) / 2
    assert getattr(getattr(configured("ash", "ci", {old: value}), part), field) == value
    command = read_command(TrainCommand, "train", ["ash", "data/x", "--preset", "ci", f"--{old}", str(value)])
    assert command.changes == ((new, value),)
