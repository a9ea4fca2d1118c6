"""The gate's error rates: planted defects have an effect, and the verdicts on them are counted."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes, planted_defects
from helpers.captures import tiny_plus, write_tube_capture

from ash.capture.dataset import Capture, Pose
from ash.files import InputError, read_json
from ash.protocol import Avatar, StageClock
from benchmarks.cell.registry import code_version, find_method
from benchmarks.gate import calibration, gate, remeasure
from benchmarks.suites.files import read_suite
from benchmarks.suites.runs import RunOptions


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube"))


@pytest.fixture
def changes_undone() -> Iterator[None]:
    """What a name of ASH stands for is changed by a defect for its process; here, until the test ends."""
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] == "ash"]
    classes = [found for module in modules for found in vars(module).values() if isinstance(found, type)]
    before = [(owner, dict(vars(owner))) for owner in (*modules, *classes)]
    yield
    for owner, names in before:
        for name, sound in names.items():
            if vars(owner)[name] is not sound:
                setattr(owner, name, sound)


def trained_image(factory: Callable[..., Avatar], capture: Capture, folder: Path) -> np.ndarray:
    """What a method draws after a few steps of training on a tiny model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planted_defects, "plus", lambda _: tiny_plus(steps=6, warmup_steps=2))
        avatar = factory(capture.training_only(), seed=0, preset="ci")
    avatar.fit(capture.training_only(), folder=folder)
    camera = next(iter(capture.cameras.values()))
    return avatar.render(Pose(capture.motion, 2), camera, clock=StageClock())


def none(capture: Capture, *, seed: int, preset: str) -> Avatar:
    return planted_defects._ash(capture, seed, preset)


@pytest.fixture(scope="module")
def sound_images(tube: Capture, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """What is drawn without a defect."""
    folder = tmp_path_factory.mktemp("sound")
    return {
        sound.__name__: trained_image(sound, tube, folder / sound.__name__)
        for sound in (none, planted_defects.sound_sh)
    }


@pytest.mark.parametrize("defect", planted_defects.DEFECTS, ids=lambda defect: defect.__name__)
def test_a_defect_changes_what_is_drawn_or_what_it_costs(
    defect: Callable[..., Avatar],
    tube: Capture,
    tmp_path: Path,
    sound_images: dict[str, np.ndarray],
    changes_undone: None,
) -> None:
    before = sound_images["sound_sh" if defect is planted_defects.sh_frame else "none"]
    after = trained_image(defect, tube, tmp_path)
    assert np.isfinite(after).all()
    assert np.array_equal(before, after) == (defect in (planted_defects.slow_splatter, planted_defects.more_memory))


def test_defects_can_be_loaded_where_the_generator_of_truth_is_hidden() -> None:
    """As in a cell: a defect that cannot start is none."""
    code = "import sys; sys.path.append(sys.argv[1]); sys.modules['synth'] = None; import helpers.planted_defects"
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parents[2])], check=True)


def test_one_camera_off_is_off_by_so_many_pixels(tube: Capture) -> None:
    camera = next(iter(tube.cameras.values()))
    point = (-camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3] + 3 * camera.viewmat[2, :3])[None]  # on its axis
    shift = planted_defects._turned(camera, 2.0).project(point)[0] - camera.project(point)[0]
    np.testing.assert_allclose(shift[0], [2.0, 0.0], atol=0.01)


@pytest.fixture
def on_fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates of methods that need no training: the names of defects are names of methods."""
    capture = fakes.write_capture(tmp_path / "capture")
    fakes.use(tmp_path / "plugins", monkeypatch)
    for module in (calibration, remeasure):
        monkeypatch.setattr(module, "make_capture", lambda *_, **__: capture)
    monkeypatch.setattr(calibration, "SEEDS", 2)
    monkeypatch.setattr(calibration, "TIMED_AGAIN", 1)
    monkeypatch.setattr(gate, "TIMED_AGAIN", 1)
    monkeypatch.setattr(calibration, "SOUND", "fake_good")
    monkeypatch.setattr(calibration, "SOUND_FOR", {})
    monkeypatch.setattr(calibration, "_target", lambda name: name)


@pytest.mark.usefixtures("on_fakes")
def test_unchanged_code_and_defects_are_judged_and_written_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planted_defects, "DEFECTS", (fake_bad,))
    found = calibration.calibrate(reruns=2, out=tmp_path / "out", data=tmp_path, workers=2)
    assert [trial.name for trial in found.unchanged] == ["rerun 1", "rerun 2"]
    (defect,) = found.defects
    assert any("psnr" in check.what for check in defect.flagged)
    text = (tmp_path / "out" / "calibration.md").read_text()
    assert "Planted defects reported: 1 of 1" in text and "of 2 (95 % interval" in text
    assert len(read_json(tmp_path / "out" / "calibration.json")["defects"]) == 1


def fake_bad() -> None:
    """A worse method under a better one's name."""


@pytest.mark.usefixtures("on_fakes")
def test_a_defect_that_fails_is_none_that_was_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planted_defects, "DEFECTS", (fake_raising,))
    with pytest.raises(InputError, match="fake_raising, seed 3: expected a result to judge"):
        calibration.calibrate(reruns=0, out=tmp_path / "out", data=tmp_path, workers=2)


def fake_raising() -> None:
    """A method that raises."""


def test_a_method_may_be_named_by_its_path_and_is_known_by_its_source() -> None:
    method = find_method("helpers.planted_defects:holes")
    assert method.load() is planted_defects.holes
    assert not method.is_ours
    assert code_version("helpers.planted_defects:holes") != code_version("ash")
    for wrong in ("benchmarks.nothing:holes", "nothing.at.all:f"):
        with pytest.raises(InputError, match="unknown method"):
            find_method(wrong)


def test_more_cells_are_run_of_all_methods_or_of_some(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = fakes.write_capture(tmp_path / "capture")
    fakes.use(tmp_path / "plugins", monkeypatch)
    suite = read_suite(fakes.write_suite(tmp_path, capture))
    options = RunOptions(out=tmp_path / "out", data=tmp_path, workers=1)
    both = remeasure.remeasure(suite, options, [7])
    assert [(result.config.method, result.config.seed) for result in both] == [("fake_good", 7), ("fake_bad", 7)]
    assert all(result.timing is not None for result in both)
    (one,) = remeasure.remeasure(suite, options, [7], {(both[1].config.place, "fake_bad")})
    assert one == both[1], "what is there is not run again"
