"""What can be known to be wrong before anything is rendered is refused then, in one line."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.commands import refused

from ash.files import InputError
from benchmarks import cli
from benchmarks.suites.files import find_suite
from benchmarks.suites.scenes import one_sided
from synth import cost
from synth.presets import SIZES
from synth.presets import scene as named


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--preset cup", "expected one of ci, brief, cpu"),
        ("--shard 3/2", "expected a shard i/n with 1 <= i <= n, got '3/2'"),
        ("--executor ray://x", "unknown executor 'ray://x', expected local or dask://"),
        ("--methods nowhere.module:factory", "unknown method 'nowhere.module:factory'"),
    ],
)
def test_a_wrong_run_ends_before_it_renders(flags: str, message: str, tmp_path: Path, capsys) -> None:
    places = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    told = refused(capsys, "run", "ci", *places, *flags.split())
    assert message in told and not (tmp_path / "data").exists()


def test_a_row_that_changes_nothing_is_named(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.toml").write_text(
        'scenes = ["mannequin"]\nsize = "ci"\npreset = "ci"\n'
        'methods = [{ of = "ash", name = "same", model.width = 8 }, { of = "ash", name = "wide", model.width = 12 }]\n'
    )
    assert cli.main(["run", str(tmp_path / "mine.toml"), "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert "row 'same' equals 'ash': preset ci has model.width = 8 already" in told and "'wide'" not in told


def test_a_suite_of_many_digits_is_refused_in_one_line(tmp_path: Path) -> None:
    for key in ("seeds", "cell_minutes", "limit_minutes"):
        path = tmp_path / f"{key}.toml"
        path.write_text(f'scenes = ["mannequin"]\nmethods = ["ash"]\n{key} = {"9" * 400}\n')
        with pytest.raises(InputError, match=key):
            find_suite(path)


def test_a_disk_that_is_too_small_is_told_in_a_unit_that_shows_it(tmp_path: Path, monkeypatch) -> None:
    scene = named("mannequin", size="ci")
    monkeypatch.setattr(cost.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 2_500_000}))
    with pytest.raises(InputError, match=r"the capture needs \d+\.\d MB more and the disk has 2\.5 MB free"):
        cost.require_space([(scene, tmp_path / "new")], tmp_path)


def test_test_cameras_on_one_side_of_the_person_are_told() -> None:
    """Those of size `factor` stood within 97 degrees behind the person when it had 20 cameras."""
    assert not any(one_sided(named("skinned", size=size).rig) for size in SIZES)
    few = replace(named("skinned", size="quick").rig, cameras=20)
    assert one_sided(few).startswith("no test camera in 263 of 360 degrees")
    three = replace(named("skinned", size="quick").rig, held_out=3)
    assert "4 held out" in one_sided(three), "24 cameras are not enough of an advice: these are 24"
