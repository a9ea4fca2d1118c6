import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import fakes
import pytest

from benchmarks import cli, runs
from benchmarks.experiments import SUITES, Suite
from synth.presets import SCENES

BOXES = Suite(
    name="boxes",
    about="fake methods on boxes",
    scenes=("boxes",),
    size="ci",
    methods=("fake_good", "fake_bad"),
    preset="ci",
    seeds=1,
    cell_minutes=0.1,
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fakes.write_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture(autouse=True)
def installed_fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.use(tmp_path / "plugins", monkeypatch)


def use_boxes(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Suites whose capture needs no renderer."""

    def render(spec, folder: Path, *, workers: int) -> None:
        if not folder.exists():
            shutil.copytree(capture, folder)

    monkeypatch.setitem(SCENES, "boxes", lambda size, seed: SCENES["mannequin"](size=size, seed=seed))
    monkeypatch.setitem(SUITES, "boxes", BOXES)
    monkeypatch.setitem(SUITES, "broken", replace(BOXES, name="broken", methods=("fake_good", "fake_nan")))
    monkeypatch.setattr(runs, "make_capture_in", render)


@pytest.fixture
def boxes(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_boxes(capture, monkeypatch)


@pytest.fixture(scope="module")
def made_once(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run of the suite boxes, `run`, and its capture, `data`."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        fakes.use(folder / "plugins", patch)
        use_boxes(capture, patch)
        assert cli.main(["run", "boxes", "--out", str(folder / "run"), "--data", str(folder / "data")]) == cli.DONE
    return folder


@pytest.fixture
def finished(made_once: Path, boxes: None, tmp_path: Path) -> Path:
    """A copy of the finished run; its capture lies beside it."""
    shutil.copytree(made_once / "data", tmp_path / "data")
    return Path(shutil.copytree(made_once / "run", tmp_path / "run"))


def refused(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The one line with which a command is refused."""
    assert cli.main(list(command)) == cli.WRONG_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("ash-bench: ")
    return lines[0]


def damaged(capture: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(capture, tmp_path / "damaged"))


def test_a_run_leaves_its_report(finished: Path) -> None:
    for name in ("report.html", "report.md", "results.csv", "tables.tex", "chart_boxes.svg", "pictures_boxes.png"):
        assert (finished / name).stat().st_size > 0, name
    (cell, _) = sorted((finished / "cells").iterdir())
    assert {"config.json", "result.json", "log.jsonl", "images"} <= {path.name for path in cell.iterdir()}


def test_a_second_run_repeats_nothing(finished: Path, capsys) -> None:
    before = {path: path.read_bytes() for path in [*finished.rglob("result.json"), finished / "report.html"]}
    command = ["run", "boxes", "--out", str(finished), "--data", str(finished.parent / "data")]
    assert cli.main(command) == cli.DONE
    told = capsys.readouterr()
    assert "fake_good is best on held-out views" in told.out
    assert "2 of 2 cells are there already" in told.err
    changed = {path for path, content in before.items() if path.read_bytes() != content}
    assert changed <= {finished / "report.html"}, "only the page may change: it names the command"


def test_a_failed_cell_is_told_and_exits_with_1(boxes: None, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    assert cli.main(["run", "broken", "--out", str(out), "--data", str(tmp_path / "data")]) == cli.FAILED
    told = capsys.readouterr()
    assert "diverged: the rendered image holds NaN or infinity" in told.err
    assert "fake_nan" in (out / "report.html").read_text()
    assert "fake_nan" in (out / "results.csv").read_text()


def test_rescore_recomputes_every_number_from_the_stored_images(capture: Path, tmp_path: Path, capsys) -> None:
    assert cli.main(["train", "fake_good", str(capture), "--preset", "ci", "--out", str(tmp_path)]) == cli.DONE
    path = next(tmp_path.rglob("result.json"))
    out, original = path.parent, path.read_bytes()
    path.write_bytes(original.replace(b'"foreground/psnr": ', b'"foreground/psnr": 1'))
    assert cli.main(["rescore", str(out)]) == cli.DONE
    assert path.read_bytes() == original
    capsys.readouterr()
    image = sorted(path.parent.rglob("*.png"))[0]
    shutil.copy(sorted(path.parent.rglob("*.png"))[1], image)
    assert "altered since it was scored" in refused(capsys, "rescore", str(out))


def test_eval_renders_again_from_the_checkpoint(capture: Path, tmp_path: Path) -> None:
    assert cli.main(["train", "fake_good", str(capture), "--preset", "ci", "--out", str(tmp_path)]) == cli.DONE
    path = next(tmp_path.rglob("result.json"))
    before = json.loads(path.read_text())
    shutil.rmtree(path.parent / "images")
    assert cli.main(["eval", str(path.parent)]) == cli.DONE
    assert json.loads(path.read_text())["views"] == before["views"]


def test_dry_run_starts_nothing(tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    assert cli.main(["run", "ci", "--out", str(out), "--seeds", "2", "--dry-run"]) == cli.DONE
    told = capsys.readouterr().out
    assert f"{2 * len(SUITES['ci'].methods)} cells" in told
    assert "GB" in told and "core-hours" in told
    assert not out.exists()


def test_unknown_names(capture: Path, tmp_path: Path, capsys) -> None:
    assert "unknown suite 'nosuch', expected one of quick, table, ladder, " in refused(capsys, "run", "nosuch")
    assert "unknown method 'nosuch', expected one of" in refused(capsys, "train", "nosuch", str(capture))
    assert "expected a shard i/n" in refused(capsys, "run", "ci", "--shard", "3/2", "--dry-run")


def test_a_missing_image(capture: Path, tmp_path: Path, capsys) -> None:
    folder = damaged(capture, tmp_path)
    (folder / "frames" / "cam0" / "000002.png").unlink()
    assert "cam0/000002.png: missing" in refused(capsys, "train", "fake_good", str(folder))
    assert cli.main(["verify", str(folder)]) == cli.WRONG_INPUT


def test_a_truncated_image(capture: Path, tmp_path: Path, capsys) -> None:
    folder = damaged(capture, tmp_path)
    image = folder / "frames" / "cam0" / "000002.png"
    image.write_bytes(image.read_bytes()[:-200])
    assert "cam0/000002.png: altered" in refused(capsys, "train", "fake_good", str(folder))


def test_a_wrong_hash(capture: Path, tmp_path: Path, capsys) -> None:
    folder = damaged(capture, tmp_path)
    path = folder / "motion.npz"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1  # In the archive's comment length: still readable, and still not what was made.
    path.write_bytes(bytes(content))
    assert cli.main(["verify", str(folder)]) == cli.WRONG_INPUT
    assert "motion.npz: altered (SHA-256 differs from the manifest)" in capsys.readouterr().err
    assert cli.main(["verify", str(capture)]) == cli.DONE


def test_another_schema_version(capture: Path, tmp_path: Path, capsys) -> None:
    folder = damaged(capture, tmp_path)
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"schema": 1', '"schema": 99'))
    assert "expected capture schema 1, got 99" in refused(capsys, "train", "fake_good", str(folder))


def test_an_unfinished_capture_and_no_capture(capture: Path, tmp_path: Path, capsys) -> None:
    folder = damaged(capture, tmp_path)
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"complete": true', '"complete": false'))
    assert "unfinished" in refused(capsys, "train", "fake_good", str(folder))
    assert "manifest.json" in refused(capsys, "train", "fake_good", str(tmp_path / "nowhere"))


def test_a_folder_that_cannot_be_written(capture: Path, tmp_path: Path, capsys) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "a part of the path is a file" in refused(
        capsys, "run", "ci", "--out", str(blocked / "run"), "--data", str(tmp_path)
    )


def test_no_space_on_the_device(capture: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=40k", "tmpfs", small], capture_output=True).returncode:
        pytest.skip("mounting a small file system needs rights that this user lacks")
    try:
        told = ash_bench("train", "fake_good", str(capture), "--out", str(small))
        assert told.returncode == cli.WRONG_INPUT
        assert told.stderr.strip().splitlines()[-1].endswith("no space left on the device")
        assert "Traceback" not in told.stderr
    finally:
        subprocess.run(["umount", small], check=True)


def test_a_file_beyond_the_systems_limit(capture: Path, tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    told = ash_bench("train", "fake_good", str(capture), "--out", str(tmp_path / "out"), preexec_fn=limit)
    assert told.returncode == cli.WRONG_INPUT
    assert "larger than the system allows" in told.stderr
    assert "Traceback" not in told.stderr


def test_reports_need_a_finished_cell(finished: Path, tmp_path: Path, capsys) -> None:
    assert "expected a JSON file" in refused(capsys, "report", str(tmp_path))
    out = finished
    results = sorted(out.rglob("result.json"))
    page = (out / "report.html").read_bytes()
    results[0].write_bytes(results[0].read_bytes()[:300])
    assert "result.json" in refused(capsys, "report", str(out))
    for path in results:
        path.unlink()
    assert "no cell is finished" in refused(capsys, "report", str(out))
    assert (out / "report.html").read_bytes() == page


def test_ctrl_c_exits_with_130_and_the_same_command_goes_on(capture: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.cli", "train", "fake_sleeping", str(capture), "--out", str(tmp_path)]
    for number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        while not list(tmp_path.glob("cells/*/log.jsonl")):
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(number)
        _, told = process.communicate(timeout=20)
        assert process.returncode == cli.INTERRUPTED
        assert told.strip().endswith("interrupted; the same command goes on where it was")
        shutil.rmtree(tmp_path / "cells")


def test_help_lists_only_verbs_that_exist(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    told = capsys.readouterr().out
    for verb in ("run", "synth", "verify", "train", "eval", "rescore", "report", "speed", "doctor", "test"):
        assert f"    {verb} " in told


def test_help_is_quick() -> None:
    start = time.monotonic()
    code = "import sys; sys.argv = ['ash-bench', '--help']\nfrom benchmarks.cli import main\n"
    code += (
        "try:\n  main()\nexcept SystemExit:\n  pass\nassert 'torch' not in sys.modules and 'pandas' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert time.monotonic() - start < 3


def test_wrong_use_exits_with_2(capsys) -> None:
    for command in ([], ["nosuch"], ["run", "--seeds", "0"], ["run", "--workers", "x"], ["speed", "else"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(command)
        assert stop.value.code == cli.WRONG_INPUT


def ash_bench(*command: str, preexec_fn=None) -> subprocess.CompletedProcess[str]:
    whole = [sys.executable, "-m", "benchmarks.cli", *command]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        whole, env=environment, capture_output=True, text=True, timeout=60, preexec_fn=preexec_fn, check=False
    )


def test_the_code_version_follows_every_deciding_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks import experiments

    root = Path(shutil.copytree(Path(experiments.__file__).parent.parent / "ash", tmp_path / "ash"))
    monkeypatch.setattr(experiments, "_package_folder", lambda package: root)
    seen = set()
    for path in (None, root / "avatar.py", root / "native" / "splat.cpp", root / "native" / "project.inc"):
        if path is not None:
            path.write_text(path.read_text() + "\n")
        experiments.code_version.cache_clear()
        seen.add(experiments.code_version("fake_good"))
    experiments.code_version.cache_clear()
    assert len(seen) == 4
    assert experiments._package_folder("ash") == root


def test_the_code_version_reads_the_sources_that_run() -> None:
    import ash.files
    from benchmarks.experiments import _package_folder

    assert _package_folder("ash") == Path(ash.files.__file__).parent


def test_two_runs_in_one_folder_do_not_meet(boxes: None, tmp_path: Path, capsys) -> None:
    from benchmarks.locks import only_run_in

    (tmp_path / "run").mkdir()
    with only_run_in(tmp_path / "run"):
        assert "another ash-bench is at work there" in refused(
            capsys, "run", "boxes", "--out", str(tmp_path / "run"), "--data", str(tmp_path / "data")
        )


def test_shards_are_merged_into_the_undisturbed_run(finished: Path, tmp_path: Path, capsys) -> None:
    data, whole = ["--data", str(tmp_path / "data")], finished
    shards = [tmp_path / "a", tmp_path / "b"]
    for index, shard in enumerate(shards, 1):
        assert cli.main(["run", "boxes", "--out", str(shard), "--shard", f"{index}/2", *data]) == cli.DONE
    assert "are in no shard" in refused_last(capsys, "merge", str(shards[0]), "--out", str(tmp_path / "half"))
    assert cli.main(["merge", *map(str, shards), "--out", str(tmp_path / "merged")]) == cli.DONE
    quality = [
        [
            line
            for line in (run / "results.csv").read_text().splitlines()
            if ",speed," not in line and ",memory," not in line
        ]
        for run in (whole, tmp_path / "merged")
    ]
    assert quality[0] == quality[1] and len(quality[0]) > 40


def test_the_gate_on_a_run(finished: Path, tmp_path: Path, capsys) -> None:
    baseline = tmp_path / "baseline.json"
    gate = ["gate", "--baseline", str(baseline), "--head", str(finished)]
    assert "baseline.json" in refused_last(capsys, *gate)
    assert cli.main([*gate, "--update-baseline"]) == cli.DONE
    assert cli.main([*gate, "--markdown", str(tmp_path / "s.md"), "--junit", str(tmp_path / "j.xml")]) == cli.DONE
    assert "passed" in (tmp_path / "s.md").read_text() and (tmp_path / "j.xml").exists()
    baseline.write_text(baseline.read_text().replace('"params": 2', '"params": 1'))
    assert cli.main(gate) == cli.FAILED


def refused_last(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The last line of a command that is refused after others spoke."""
    assert cli.main(list(command)) == cli.WRONG_INPUT
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_a_capture_of_an_older_scene_is_kept_and_the_new_one_goes_beside_it(
    boxes: None, capture: Path, tmp_path: Path
) -> None:
    old = tmp_path / "data" / "boxes-ci-0"
    shutil.copytree(capture, old)
    manifest = old / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"complete"', '"identity": "older", "complete"'))
    assert cli.main(["run", "boxes", "--out", str(tmp_path / "run"), "--data", str(tmp_path / "data")]) == cli.DONE
    assert "older" in manifest.read_text()
    assert len(list((tmp_path / "data").iterdir())) == 2
