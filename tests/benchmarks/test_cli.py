import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers.commands import refused, refused_last
from helpers.waiting import wait_for

import ash.files
from ash.capture.manifest import read_manifest
from ash.files import read_json, require_plain, write_json
from benchmarks import cli
from benchmarks.cell import registry
from benchmarks.cell.sandbox import METHOD_PATH
from benchmarks.cell.schema import read_result, write_config, write_result
from benchmarks.commands import arguments
from benchmarks.commands.captures import SynthCommand
from benchmarks.suites import captures
from benchmarks.suites.files import find_suite
from benchmarks.suites.reuse import TRAINED_BY
from benchmarks.suites.runs import read_run
from benchmarks.suites.suites import CaptureSpec

pytestmark = pytest.mark.usefixtures("installed_fakes")


def test_a_run_leaves_its_report(finished: Path) -> None:
    for name in ("report.html", "report.md", "results.csv", "tables.tex", "chart_boxes.svg", "pictures_boxes.webp"):
        assert (finished / name).stat().st_size > 0, name
    (cell, _) = sorted((finished / "cells").iterdir())
    assert {"config.json", "result.json", "log.jsonl", "images"} <= {path.name for path in cell.iterdir()}


def test_a_second_run_repeats_nothing(finished: Path, boxes: str, capsys) -> None:
    before = {path: path.read_bytes() for path in [*finished.rglob("result.json"), finished / "report.html"]}
    assert cli.main(["run", boxes, "--out", str(finished)]) == arguments.DONE
    told = capsys.readouterr()
    assert "Smoke test on boxes" in told.out
    assert "2 of 2 cells are there already" in told.err
    changed = {path for path, content in before.items() if path.read_bytes() != content}
    assert changed <= {finished / "report.html"}, "only the page may change: it names the command"


def test_a_failed_cell_is_told_and_exits_with_1(finished: Path, boxes: str, capsys) -> None:
    assert cli.main(["run", boxes, "--methods", "fake_good,fake_nan", "--out", str(finished)]) == arguments.FAILED
    told = capsys.readouterr()
    assert "diverged: the rendered image holds NaN or infinity" in told.err
    assert "fake_nan" in (finished / "report.html").read_text()
    assert "fake_nan" in (finished / "results.csv").read_text()


def test_rescore_recomputes_every_number_from_the_stored_images(finished: Path, capsys) -> None:
    path = next(finished.rglob("result.json"))
    out, original = path.parent, path.read_bytes()
    path.write_bytes(original.replace(b'"foreground/psnr": ', b'"foreground/psnr": 1'))
    assert cli.main(["eval", "--scores-only", str(out)]) == arguments.DONE
    assert path.read_bytes() == original
    capsys.readouterr()
    image = sorted(path.parent.rglob("*.png"))[0]
    shutil.copy(sorted(path.parent.rglob("*.png"))[1], image)
    assert "altered since it was scored" in refused(capsys, "eval", "--scores-only", str(out))


def test_what_train_made_is_reported_and_evaluated_also_when_it_was_moved(
    capture: Path, tmp_path: Path, capsys
) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    shutil.copytree(capture, before / "data" / "boxes")
    train = ["train", "fake_good", str(before / "data" / "boxes"), "--preset", "ci", "--out", str(before / "runs")]
    assert cli.main(train) == arguments.DONE
    before.rename(after)
    cell = next(after.glob("runs/cells/*"))
    views = json.loads((cell / "result.json").read_text())["views"]
    for command in (["report", str(after / "runs")], ["report", str(cell)], ["eval", str(cell)]):
        if command[0] == "eval":  # It draws from the checkpoint, whatever pictures are there.
            shutil.rmtree(cell / "images")
        capsys.readouterr()
        assert cli.main(command) == arguments.DONE, command
        assert "fake_good" in capsys.readouterr().out
    assert json.loads((cell / "result.json").read_text())["views"] == views
    assert "Side by side" in (cell / "report.html").read_text()
    assert "No pictures" not in (after / "runs" / "report.html").read_text()


def test_a_methods_configuration_is_flags_recorded_hashed_and_used(capture: Path, tmp_path: Path, capsys) -> None:
    """On a person that is there to choose by, whom training takes."""
    person = str(with_subject(capture, tmp_path / "capture", 100))
    train = ["train", "fake_tuned", person, "--preset", "ci", "--out", str(tmp_path)]
    found, psnr = {}, {}
    for flags in ((), ("--detail", "0.8"), ("--detail", "0.5"), ("--detail", "0.8", "--row", "sharp")):
        assert cli.main([*train, *flags]) == arguments.DONE
        told = capsys.readouterr()
        folder = Path(told.out.strip().rpartition(" in ")[2])
        found[flags] = json.loads((folder / "config.json").read_text())["config"]
        psnr[flags] = float(told.out.partition("novel view ")[2].split()[0])
    assert "taken as it is" not in told.err
    assert len(list((tmp_path / "cells").iterdir())) == 3, "what the preset says anyway is no change"
    assert psnr["--detail", "0.8"] > psnr[()] + 1
    varied = found["--detail", "0.8"]
    assert (varied["method"], varied["factory"], varied["changes"]) == (
        "fake_tuned+detail=0.8",
        "fake_tuned",
        {"detail": 0.8},
    )
    assert found["--detail", "0.8", "--row", "sharp"]["method"] == "sharp" and varied["subject"] == 100
    assert cli.main([*train, "--detail", "0.8"]) == arguments.DONE
    assert "trained before, from the same inputs" in capsys.readouterr().err
    assert "detail: expected 0 to 1, got 2.0" in refused(capsys, *train, "--detail", "2")
    assert "--row: " in refused(capsys, *train, "--row", "a/b")
    oracle = refused(capsys, "train", "ash_truth", str(capture), "--row", "mine")
    assert "expected a name that begins with 'ash_truth', an oracle" in oracle
    assert "unknown option '--detial', did you mean --detail" in refused(capsys, *train, "--detial", "2")
    assert "preset: expected one of ci, cpu, got 'huge'" in refused(capsys, *train[:3], "--preset", "huge")


def test_a_scenes_fields_are_flags_and_part_of_what_it_is(capsys) -> None:
    command = ["mannequin", "--size", "ci", "--rig.cameras", "9", "--train.0.frames", "6", "--outfit.skirt", "False"]
    scene, name = arguments.read_command(SynthCommand, "synth", command)._described()
    assert (scene.rig.cameras, scene.train[0].frames, scene.train[1].frames, scene.outfit.skirt) == (9, 6, 4, False)
    assert scene.name == "mannequin+skirt=False+cameras=9+frames=6"
    assert name == f"mannequin-ci-0-{scene.identity[:8]}" and scene.parameters["rig"]["cameras"] == 9
    command = ["mannequin", "--rig.cameras=9", "--size", "quick"]
    same, _ = arguments.read_command(SynthCommand, "synth", command)._described()
    assert same.identity != scene.identity and same.rig.cameras == 9
    plain = arguments.read_command(SynthCommand, "synth", ["mannequin", "--size", "ci"])
    assert plain._described() == (plain.settings(), "mannequin-ci-0")
    command = ["mannequin", "--size", "ci", "--subject", "103", "--seed", "7"]
    person, name = arguments.read_command(SynthCommand, "synth", command)._described()
    assert (name, person.name, person.subject) == ("mannequin-ci-7-subject103", "mannequin", 103)
    splats, _ = arguments.read_command(SynthCommand, "synth", ["splats", "--size", "ci", "--name", "mine"])._described()
    assert (splats.name, splats.body) == ("mine", "mannequin")
    command = ["mannequin", "--train.0.shift", "-0.5", "0", "--light.sky", "0.3", "--size", "ci"]
    moved, _ = arguments.read_command(SynthCommand, "synth", command)._described()
    assert (moved.train[0].shift, moved.light.sky) == ((-0.5, 0.0), 0.3)
    assert require_plain(moved.name, what="scene") == "mannequin+sky=0.3+shift=-0.5_0.0"


def test_a_methods_mistake_comes_with_file_and_line(capture: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    (tmp_path / "own_method.py").write_text("def mine(capture, *, seed, preset):\n    return 1 / 0\n")
    (tmp_path / "own_typo.py").write_text("import nowhere_to_be_found\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv(METHOD_PATH, "")
    assert "--method-path DIR" in refused(capsys, "train", "own_method:mine", str(capture))
    train = ["train", "own_method:mine", str(capture), "--out", str(tmp_path / "out"), "--method-path", str(tmp_path)]
    assert cli.main(train) == arguments.FAILED
    assert "crashed: ZeroDivisionError: division by zero (" in (told := capsys.readouterr().err)
    assert "own_method.py:2)" in told
    told = refused(capsys, "train", "own_typo:mine", str(capture))
    assert "cannot be imported: ModuleNotFoundError" in told and "own_typo.py:1)" in told


def test_suites_are_printed_as_files(tmp_path: Path, capsys) -> None:
    assert cli.main(["run", "quick", "--list"]) == arguments.DONE
    (tmp_path / "copy.toml").write_text(capsys.readouterr().out)
    mine, ours = find_suite(tmp_path / "copy.toml"), find_suite("quick")
    assert replace(mine, name="quick") == ours


def with_subject(capture: Path, folder: Path, subject: int) -> Path:
    """A copy of a capture that says whom it shows."""
    shutil.copytree(capture, folder)
    manifest = read_manifest(folder)
    replace(manifest, parameters=manifest.parameters | {"subject": subject}).write(folder)
    return folder


def test_a_run_refuses_what_is_for_validation(capture: Path, tmp_path: Path, capsys) -> None:
    folder = with_subject(capture, tmp_path / "capture", 100)
    run = ["run", "ci", "--capture", str(folder), "--methods", "fake_good", "--out", str(tmp_path / "out")]
    assert "subject 100 is for validation and tuning, expected one below 100" in refused(capsys, *run)
    replace(read_manifest(capture), seed=123).write(folder)
    assert "seed 123 is for validation and tuning, expected one below 100" in refused(capsys, *run)


def test_people_to_choose_by_have_runs_of_their_own_which_say_so(
    finished: Path, capture: Path, tmp_path: Path, capsys
) -> None:
    """Those of the finished run are for tables."""
    chosen = with_subject(capture, tmp_path / "capture", 100)
    run = ["run", "ci", "--methods", "fake_good", "--validation", "--out", str(tmp_path / "search")]
    search, table = tmp_path / "search", finished
    assert "expected it or --scenes" in refused_last(capsys, *run, "--capture", str(chosen), "--scenes", "tight")
    assert cli.main([*run, "--capture", str(chosen)]) == arguments.DONE
    assert "boxes" in (search / "report.md").read_text(), "the scene of the capture that was given"
    assert "are for validation: choose by these numbers" in (search / "report.md").read_text()
    assert "choose by these numbers" not in (table / "report.md").read_text()
    assert "subject 0 is for tables, expected one from 100 on" in refused_last(capsys, *run, "--capture", str(capture))
    mixed = ("report", str(search), str(table), "--out", str(tmp_path / "both"))
    assert "expected a report without the others" in refused_last(capsys, *mixed)
    assert cli.main(["report", str(table), "--chosen-on", str(search)]) == arguments.DONE
    assert "--chosen-on" in (table / "report.md").read_text(), "the command says by whom was chosen"
    assert "expected a run of `--validation`" in refused_last(capsys, "report", str(search), "--chosen-on", str(table))


def test_a_scene_that_a_suite_has_under_other_names_only_is_asked_for_by_them(tmp_path: Path, capsys) -> None:
    suite = tmp_path / "mine.toml"
    suite.write_text('scenes = [{ of = "still", rig.cameras = 160 }]\nmethods = ["ash"]\npreset = "ci"\n')
    told = refused(capsys, "run", str(suite), "--scenes", "still", "--dry-run")
    assert "mine has 'still' as still+cameras=160: expected that name in --scenes" in told
    assert cli.main(["run", str(suite), "--scenes", "still+cameras=160", "--dry-run"]) == arguments.DONE


def test_dry_run_starts_nothing(tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    assert cli.main(["run", "ci", "--out", str(out), "--seeds", "2", "--dry-run"]) == arguments.DONE
    told = capsys.readouterr().out
    assert f"{2 * len(find_suite('ci').methods)} cells" in told
    assert "GB" in told and "core-hours" in told
    assert not out.exists()


def test_dry_run_does_not_count_a_finished_capture(ci_data: Path, capsys) -> None:
    assert cli.main(["run", "ci", "--data", str(ci_data), "--dry-run"]) == arguments.DONE
    told = capsys.readouterr().out
    assert "capture mannequin-ci-0: is there" in told and "GB" not in told


def test_reports_need_a_finished_cell(finished: Path, tmp_path: Path, capsys) -> None:
    assert "run.json: cannot be read" in refused(capsys, "report", str(tmp_path))
    out = finished
    results = sorted(out.rglob("result.json"))
    page = (out / "report.html").read_bytes()
    results[0].write_bytes(results[0].read_bytes()[:300])
    assert "result.json" in refused(capsys, "report", str(out))
    for path in results:
        path.unlink()
    assert "no cell is finished" in refused(capsys, "report", str(out))
    assert (out / "report.html").read_bytes() == page


# An interrupt may fall between an open(), ours or psutil's, and its `with`: the file is closed when it is collected.
@pytest.mark.filterwarnings("ignore:.*FileIO name=:pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_exits_with_130_and_the_same_command_goes_on(capture: Path, tmp_path: Path, capsys) -> None:
    def interrupt_the_training(number: int) -> None:
        wait_for(lambda: list(tmp_path.glob("cells/*/*/log.jsonl")))
        os.kill(os.getpid(), number)

    for number in (signal.SIGINT, signal.SIGTERM):
        threading.Thread(target=interrupt_the_training, args=(number,)).start()
        command = ["train", "fake_sleeping", str(capture), "--out", str(tmp_path)]
        assert cli.main(command) == arguments.INTERRUPTED
        assert capsys.readouterr().err.endswith("interrupted; the same command goes on where it was\n")
        assert not list(tmp_path.glob("cells/*/result.json"))
        shutil.rmtree(tmp_path / "cells")


def test_the_code_version_follows_every_deciding_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert registry._package_folder("ash") == Path(ash.files.__file__).parent, "it reads the sources that run"
    root = Path(shutil.copytree(Path(ash.files.__file__).parent, tmp_path / "ash"))
    monkeypatch.setattr(registry, "_package_folder", lambda package: root)
    seen = set()
    for path in (None, root / "model.py", root / "native" / "splat.cpp", root / "native" / "project.inc"):
        if path is not None:
            path.write_text(path.read_text() + "\n")
        registry.code_version.cache_clear()
        seen.add(registry.code_version("fake_good"))
    registry.code_version.cache_clear()
    assert len(seen) == 4
    assert registry._package_folder("ash") == root


def test_a_run_reuses_the_trainings_of_other_code_in_its_own_folder(boxes: str, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    command = ["run", boxes, "--methods", "fake_good", "--seeds", "2", "--out", str(out)]
    assert cli.main(command) == arguments.DONE
    for cell in read_run(out).cells:  # as if other code had trained them
        config = replace(cell.config, code="0" * 16)
        result, earlier = read_result(cell.folder), replace(cell, config=config, folder=out / "cells" / config.key)
        assert result is not None
        cell.folder.rename(earlier.folder)
        write_config(earlier)
        write_result(earlier.folder, replace(result, config=config))
    write_json(out / "run.json", read_json(out / "run.json") | {"cells": [path.name for path in cells_in(out)]})
    capsys.readouterr()
    assert cli.main([*command, "--reuse", str(out)]) == arguments.DONE
    assert "boxes · fake_good: all 26 pictures are the same, 1 cell reused" in capsys.readouterr().err
    assert len(cells_in(out)) == 4
    report = (out / "report.md").read_text()
    assert "1 of 2 trainings are those of an earlier run by other code" in report
    assert f"| code of reused trainings | {'0' * 16} |" in report
    damaged = next(each for each in read_run(out).cells if TRAINED_BY in read_result(each.folder).provenance.versions)
    (damaged.folder / "result.json").write_text("")
    assert cli.main([*command, "--reuse", str(earlier.folder)]) == arguments.DONE
    assert "run again, its result is damaged" in capsys.readouterr().err
    assert read_result(damaged.folder).status == "done"
    assert "without --shard" in refused(capsys, *command, "--reuse", str(out), "--shard", "1/2")


def cells_in(run: Path) -> list[Path]:
    return sorted((run / "cells").iterdir())


def test_two_runs_in_one_folder_do_not_meet(boxes: str, tmp_path: Path, capsys) -> None:
    from ash.files import run_lock

    (tmp_path / "run").mkdir()
    with run_lock(tmp_path / "run"):
        assert "another ash-bench is at work there" in refused(capsys, "run", boxes, "--out", str(tmp_path / "run"))


def test_shards_are_merged_into_the_undisturbed_run(finished: Path, boxes: str, tmp_path: Path, capsys) -> None:
    """Each shard has done its cell before, and finds it."""
    shards = [Path(shutil.copytree(finished, tmp_path / name)) for name in ("a", "b")]
    cells = json.loads((finished / "run.json").read_text())["cells"]
    for index, (shard, flag) in enumerate(zip(shards, (["--shard", "1/2"], ["--shard=2/2"]), strict=True), 1):
        shutil.rmtree(shard / "cells" / cells[2 - index])
        assert cli.main(["run", boxes, *flag, "--out", str(shard)]) == arguments.DONE
        assert "1 of 1 cells are there already" in capsys.readouterr().err
        command = json.loads((shard / "run.json").read_text())["command"]
        assert command.endswith(f"run {boxes} --out {shard}"), "of all shards together"
    twice = ["report", str(shards[0]), str(shards[0]), "--out", str(tmp_path / "half")]
    assert re.search(r"cells are in no shard, the first: \w+ .* seed 0", refused_last(capsys, *twice))
    assert cli.main(["report", *map(str, shards), "--out", str(tmp_path / "merged")]) == arguments.DONE
    tables = [(run / "results.csv").read_text().splitlines() for run in (finished, tmp_path / "merged")]
    quality = [[line for line in lines if ",speed," not in line and ",memory," not in line] for lines in tables]
    assert quality[0] == quality[1] and len(quality[0]) > 40


def test_a_capture_of_an_older_scene_is_kept_and_the_new_one_goes_beside_it(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []
    monkeypatch.setattr(captures, "make_capture_in", lambda spec, folder, *, workers: made.append(folder))
    old = tmp_path / "mannequin-ci-0"
    shutil.copytree(capture, old)
    manifest = old / "manifest.json"
    spec = CaptureSpec(scene="mannequin", size="ci")
    own = captures.described(spec).identity
    for identity, folder in (("older", tmp_path / f"mannequin-ci-0-{own[:8]}"), (own, old)):
        manifest.write_text((capture / "manifest.json").read_text().replace("{", f'{{"identity": "{identity}",', 1))
        assert captures.make_capture(spec, tmp_path, workers=1) == folder == made.pop()
        assert identity in manifest.read_text()


def test_a_variant_of_a_scene_has_a_capture_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "make_capture_in", lambda spec, folder, *, workers: None)
    plain = CaptureSpec(scene="mannequin", size="ci")
    seen = CaptureSpec(scene="seen", size="ci", of="mannequin", changes=(("rig.cameras", 9),))
    folders = {captures.make_capture(spec, tmp_path, workers=1) for spec in (plain, seen)}
    assert folders == {tmp_path / "mannequin-ci-0", tmp_path / "seen-ci-0"}
    assert (captures.described(seen).rig.cameras, captures.described(seen).name) == (9, "seen")
    assert captures.described(seen).identity != captures.described(plain).identity


OPENMP = ("OMP_NUM_THREADS", "GOMP_SPINCOUNT", "OMP_WAIT_POLICY")


def test_commands_set_how_idle_threads_wait_unless_the_user_did() -> None:
    """Torch's OpenMP runtime, loaded alone, prints what it was told."""
    (torch,) = find_spec("torch").submodule_search_locations
    runtime = next(Path(torch, "lib").glob("libgomp*"), None)
    if runtime is None:
        pytest.skip("torch's OpenMP runtime is not GNU's")
    settings = {name: value for name, value in os.environ.items() if name not in OPENMP}
    code = f"import ctypes; from benchmarks import cli; ctypes.CDLL({str(runtime)!r})"
    for given, spins in (({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, "0")):
        own = settings | given | {"OMP_DISPLAY_ENV": "verbose"}
        done = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, check=True)
        reported = {name: re.findall(rf"{name} ?= ?'(\w+)'", done.stderr) for name in OPENMP}
        assert (reported["GOMP_SPINCOUNT"], reported["OMP_NUM_THREADS"]) == ([spins], ["1"])


def test_commands_give_blas_one_thread_as_in_cells() -> None:
    """`eval` and `train` take times in this process: a second thread that waits busily falsifies them."""
    code = """
import os
from benchmarks import cli
import numpy as np
np.ones((500, 500)) @ np.ones((500, 500))
print(len(os.listdir("/proc/self/task")))
"""
    settings = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"
