"""Packs: made, verified by their pixels, and refused where they are hostile."""

import json
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import refused
from helpers.packs import Files, change, change_json, read_files, write_files
from PIL import Image

from ash.capture.manifest import hash_files, read_manifest
from ash.files import InputError, sha256_of
from benchmarks import cli
from benchmarks.cell.schema import CHECKPOINT
from benchmarks.suites import verification
from benchmarks.suites.archive import read_pack, unpacked, without_places, write_archive
from benchmarks.suites.runs import read_run

pytestmark = pytest.mark.usefixtures("scored_once")


@pytest.fixture(scope="session")
def packed(made_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pack of one cell."""
    path = tmp_path_factory.mktemp("packed") / "mine.zip"
    cell = next(cell for cell in read_run(made_once).cells if cell.config.method == "fake_good")
    assert cli.main(["pack", str(cell.folder), "--out", str(path)]) == cli.DONE
    return path


@pytest.fixture
def pack(packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, in a folder where nothing else is."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(packed, tmp_path / "mine.zip"))


def test_a_pack_is_scored_again_from_its_pixels(made_once: Path, capture: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "all.zip"
    assert cli.main(["pack", str(made_once), "--out", str(path)]) == cli.DONE
    assert "52 pictures, 2 hashes of avatars" in capsys.readouterr().out
    assert cli.main(["verify", str(path), "--capture", str(capture)]) == cli.DONE
    told = capsys.readouterr().out
    assert "57 files, names, sizes and SHA-256 as pack.json says" in told
    assert told.count("26 pictures scored again") == 2 and told.count("scores are equal; LPIPS is not checked") == 2
    assert "Only reported: training seconds" in told
    files, before = read_files(path), path.read_bytes()
    assert not any(str(capture.parent).encode() in files[name] for name in files if name.endswith("config.json"))
    checkpoints = json.loads(files["pack.json"])["checkpoints"]
    assert checkpoints == {cell.config.key: sha256_of(cell.folder / CHECKPOINT) for cell in read_run(made_once).cells}
    assert cli.main(["pack", str(made_once), "--out", str(path)]) == cli.DONE
    assert path.read_bytes() == before and {each.name for each in tmp_path.iterdir()} == {"all.zip"}


def test_without_its_capture_a_pack_is_not_checked(pack: Path, capture: Path, capsys) -> None:
    assert cli.main(["verify", str(pack)]) == 1
    assert "NOT CHECKED: the capture is not at hand (capture, whose manifest has" in capsys.readouterr().out
    (pack.parent / "data").mkdir()
    (pack.parent / "data" / "capture").symlink_to(capture)
    assert cli.main(["verify", str(pack)]) == cli.DONE  # found by its name
    assert "scores are equal" in capsys.readouterr().out
    assert "expected a file" in refused(capsys, "verify", str(capture), "--capture", str(capture))
    assert "manifest.json" in refused(capsys, "verify", str(pack), "--capture", "nowhere")


def test_the_scene_rendered_elsewhere_gives_the_same_within_tolerance(
    pack: Path, capture: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """Another processor draws other pixels of the same scene; a fake capture has no scene, so it is given one."""
    elsewhere = Path(shutil.copytree(capture, pack.parent / "elsewhere"))
    path = next(elsewhere.glob("frames/cam3/*.png"))
    pixels = np.array(Image.open(path))
    pixels[0, 0] ^= 1
    Image.fromarray(pixels).save(path)
    replace(read_manifest(elsewhere), identity="scene", files=hash_files(elsewhere)).write(elsewhere)
    monkeypatch.setattr(verification, "truth_of", lambda manifest: read_config(pack)["truth"])
    assert cli.main(["verify", str(pack), "--capture", str(elsewhere)]) == cli.DONE
    assert "within what counts as no change (the same scene, rendered elsewhere)" in capsys.readouterr().out
    monkeypatch.setattr(verification, "truth_of", lambda manifest: "of another scene")
    assert cli.main(["verify", str(pack), "--capture", str(elsewhere)]) == 1
    assert "NOT CHECKED" in capsys.readouterr().out
    path.unlink()
    monkeypatch.setattr(verification, "truth_of", lambda manifest: read_config(pack)["truth"])
    assert f"{path.name}: missing" in refused(capsys, "verify", str(pack), "--capture", str(elsewhere))


def read_config(pack: Path) -> dict:
    """The configuration of the only cell."""
    files = read_files(pack)
    return json.loads(next(files[name] for name in files if name.endswith("config.json")))["config"]


def _repaint(files: Files) -> None:
    name = next(name for name in files if name.endswith(".png"))
    Image.fromarray(np.full((64, 64, 4), 7, np.uint8)).save("picture.png")
    files[name] = Path("picture.png").read_bytes()


def _improve(result: dict) -> None:
    next(row for row in result["summary"] if row["metric"] == "psnr")["value"] += 0.01


def _add(result: dict) -> None:
    result["summary"].append(result["summary"][0] | {"value": 1000.0})


def _leave_out(result: dict) -> None:
    result["summary"] = [row for row in result["summary"] if row["split"] != "novel_pose"]


def _fail(result: dict) -> None:
    result.update(status="crashed", reason="once")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (_repaint, "is not the one that it names"),
        (change_json("result.json", _improve), "scores differ, the first: train_view foreground psnr is reported as"),
        (change_json("result.json", lambda result: result["views"][0]["scores"].update({"full/psnr": 99})), "differ"),
        (change_json("result.json", _add), "is reported as 1000"),
        (change_json("result.json", _leave_out), "scores are left out, the first: "),
        (change_json("result.json", lambda result: result["views"][0].update(scores={})), "scores are left out"),
        (change_json("result.json", lambda result: result["views"].reverse()), "are not the 26 views"),
        (change_json("result.json", _fail), "says that it failed, and has scores"),
    ],
)  # fmt: skip
def test_scores_that_the_pictures_do_not_have_fail(
    pack: Path, capture: Path, capsys, edit: Callable[[Files], None], message: str
) -> None:
    change(pack, edit)
    assert cli.main(["verify", str(pack), "--capture", str(capture)]) == 1
    assert message in capsys.readouterr().out


def _drop(files: Files) -> None:
    del files[next(name for name in files if name.endswith(".png"))]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (_drop, "25 pictures, and the result is of 26"),
        (change_json("config.json", lambda cell: cell["config"].update(seed=3)), "its key does not fit"),
        (change_json("run.json", lambda run: run.update(cells=[])), "run.json and the cells that are there differ"),
        (change_json("run.json", lambda run: run.update(protocol="2")), "results do not mix"),
        (change_json("pack.json", lambda pack: pack.update(protocol="2")), "expected schema 1 and protocol"),
        (change_json("pack.json", lambda pack: pack.update(schema=10**400)), "expected schema 1 and protocol"),
        (lambda files: files.pop("pack.json"), "pack.json is missing"),
        (lambda files: files.update({"../up.json": b"{}"}), "has no place in a pack"),
        (lambda files: files.update({"/abs.json": b"{}"}), "has no place in a pack"),
        (lambda files: files.update({"cells/": b""}), "has no place in a pack"),
        (lambda files: files.update({f"cells/{'0' * 16}/images/novel_view/../000000.png": b""}), "has no place"),
        (lambda files: files.update({f"cells/{'0' * 16}/result.json": b" " * 10_000_000}), "unpacks from"),
    ],
)
def test_a_pack_that_is_not_whole_is_refused_in_a_line(
    pack: Path, capsys, edit: Callable[[Files], object], message: str
) -> None:
    change(pack, edit, hashes=message != "pack.json is missing")
    line = refused(capsys, "verify", str(pack))
    assert message in line and str(pack) in line


def test_what_was_damaged_on_the_way_is_named(pack: Path, capsys) -> None:
    change(pack, _repaint, hashes=False)
    assert "altered (SHA-256 differs from pack.json)" in refused(capsys, "verify", str(pack))
    change(pack, _drop, hashes=False)
    assert ".png: missing" in refused(capsys, "verify", str(pack))


def _entry(path: Path, name: str, content: bytes = b"{}", **fields: int) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        info = zipfile.ZipInfo(name)
        for field, value in fields.items():
            setattr(info, field, value)
        archive.writestr(info, content)


def _twice(path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"):
        _entry(path, "run.json")


def _lie(path: Path) -> None:
    """The index tells other sizes than there are: the first file, packed from 10 bytes to 40 million."""
    content = bytearray(path.read_bytes())
    at = content.index(b"PK\1\2")
    content[at + 20 : at + 28] = struct.pack("<II", 1_000_000, 40_000_000)
    path.write_bytes(content)


def _long_index(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:-10] + struct.pack("<II", 1 << 31, 0) + content[-2:])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: _entry(path, f"cells/{'1' * 16}/config.json", external_attr=0o120777 << 16), "no regular file"),
        (_twice, "twice"),
        (_lie, "unpacks from"),
        (_long_index, "an index of 2147483648 bytes"),
        (lambda path: path.write_bytes(path.read_bytes() + b"tail"), "no plain end of a zip file"),
        (lambda path: path.write_bytes(b""), "no plain end of a zip file"),
        (Path.unlink, "cannot be read"),
    ],
)
def test_hostile_archives_are_refused_before_they_are_unpacked(
    pack: Path, capsys, damage: Callable[[Path], object], message: str
) -> None:
    temporary = {path.name for path in Path(tempfile.gettempdir()).glob("ash-bench-pack-*")}
    damage(pack)
    assert message in refused(capsys, "verify", str(pack))
    assert {path.name for path in Path(tempfile.gettempdir()).glob("ash-bench-pack-*")} <= temporary


def test_numbers_alone_are_no_pack(made_once: Path, tmp_path: Path) -> None:
    write_archive(read_run(made_once), tmp_path / "cells.zip")
    with unpacked(tmp_path / "cells.zip") as folder:
        assert len(read_run(folder).cells) == 2
    with pytest.raises(InputError, match=r"cells.zip: expected a pack"), unpacked(tmp_path / "cells.zip") as folder:
        read_pack(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("run --capture /home/me/data/loose --out runs/x", "run --capture data/loose --out runs/x"),
        ("run '/home/me/my.toml'; report --runs=/a/b/c,/a/b/d", "run 'me/my.toml'; report --runs=b/c,b/d"),
        ("run --executor dask://host:8786/a/b 1/2 a/b/c (views / poses)", None),
        ("cells of /runs, /runs/a", None),
    ],
)
def test_paths_of_a_machine_keep_their_last_two_names(text: str, expected: str | None) -> None:
    assert without_places(text) == (text if expected is None else expected)


def test_only_finished_cells_with_their_pictures_are_packed(finished: Path, capsys) -> None:
    first, second = sorted((finished / "cells").iterdir())
    (first / "result.json").unlink()
    assert cli.main(["pack", str(finished)]) == cli.DONE
    assert "26 pictures, 1 hashes of avatars, without 1 cells" in capsys.readouterr().out
    assert (finished.parent / "run.zip").is_file()
    shutil.rmtree(second / "images")
    assert "cannot be read" in refused(capsys, "pack", str(finished))
    (second / "result.json").unlink()
    assert "no cell is finished" in refused(capsys, "pack", str(finished))
    assert "expected the folder of a run" in refused(capsys, "pack", str(finished.parent / "run.zip"))


def test_a_large_pack_is_refused(pack: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr("benchmarks.suites.archive.LARGEST_UNPACKED", 1000)
    assert "bytes unpacked, expected at most 1000" in refused(capsys, "verify", str(pack))
    write_files(pack, {"run.json": b"{}"})
    assert "pack.json is missing" in refused(capsys, "verify", str(pack))
