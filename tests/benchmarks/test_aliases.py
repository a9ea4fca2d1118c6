"""Old names of commands and fields, which work for one release."""

import pytest

from benchmarks import cli
from benchmarks.aliases import OLD_COMMANDS
from benchmarks.commands.arguments import read_command
from benchmarks.commands.captures import SynthCommand
from benchmarks.suites.scenes import scene_of


@pytest.mark.parametrize("old", OLD_COMMANDS)
def test_an_old_command_is_the_new_one_and_says_so(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([old, "--help"])
    printed = capsys.readouterr()
    assert f"{old} is now: {' '.join(OLD_COMMANDS[old])}" in printed.err
    assert f"ash-bench {OLD_COMMANDS[old][0]}" in printed.out


def test_an_old_field_of_a_scene_is_read_as_a_flag_and_in_a_suite() -> None:
    command = read_command(SynthCommand, "synth", ["loose", "--rig.part", "5"])
    assert command.changes == (("rig.cameras_per_frame", 5),)
    old, new = (scene_of("loose", size="quick", changes=((key, 5),)) for key in ("rig.part", "rig.cameras_per_frame"))
    assert old == new and old.parameters["rig"]["part"] == 5 and "cameras_per_frame" not in old.parameters["rig"]
