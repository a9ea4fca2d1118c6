"""Captures, folders and disks that are not as they should be: each is one line, and no stack."""

import errno
import multiprocessing
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.commands import refused, refused_last

from benchmarks import cli
from benchmarks.commands import arguments
from benchmarks.suites.progress import Progress

pytestmark = pytest.mark.usefixtures("installed_fakes")


def _edited(old: str, new: str) -> Callable[[Path], object]:
    def edit(folder: Path) -> None:
        path = folder / "manifest.json"
        path.write_text(path.read_text().replace(old, new))

    return edit


def _cut(folder: Path) -> None:
    path = folder / "frames" / "cam0" / "000002.png"
    path.write_bytes(path.read_bytes()[:-200])


def _flip(folder: Path) -> None:
    path = folder / "motion.npz"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1  # In the archive's comment length: still readable, and still not what was made.
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "frames" / "cam0" / "000002.png").unlink(), "cam0/000002.png: missing"),
        (_cut, "cam0/000002.png: altered"),
        (_flip, "motion.npz: altered (SHA-256 differs from the manifest)"),
        (_edited('"schema": 1', '"schema": 99'), "expected capture schema 1, got 99"),
        (_edited('"complete": true', '"complete": false'), "unfinished"),
        (shutil.rmtree, "manifest.json"),
    ],
    ids=["missing", "truncated", "flipped", "schema", "unfinished", "none"],
)
def test_a_capture_that_is_not_whole(
    damage: Callable[[Path], object], message: str, capture: Path, tmp_path: Path, capsys
) -> None:
    folder = Path(shutil.copytree(capture, tmp_path / "damaged"))
    assert cli.main(["verify", str(folder)]) == arguments.DONE
    damage(folder)
    assert message in refused(capsys, "train", "fake_good", str(folder))
    assert cli.main(["verify", str(folder)]) == arguments.WRONG_INPUT
    assert message in capsys.readouterr().err or not folder.exists()


def test_a_folder_that_cannot_be_written(capture: Path, tmp_path: Path, capsys) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "a part of the path is a file" in refused(
        capsys, "run", "ci", "--out", str(blocked / "run"), "--data", str(tmp_path)
    )


def test_no_space_on_the_device(capture: Path, tmp_path: Path, capsys) -> None:
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=40k", "tmpfs", small], capture_output=True).returncode:
        pytest.skip("mounting a small file system needs rights that this user lacks")
    try:
        told = refused_last(capsys, "train", "fake_good", str(capture), "--out", str(small))
        assert told.endswith("no space left on the device")
    finally:
        subprocess.run(["umount", small], check=True)


def test_a_file_beyond_the_systems_limit(capture: Path, tmp_path: Path, capsys) -> None:
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, most))
    try:
        told = refused_last(capsys, "train", "fake_good", str(capture), "--out", str(tmp_path / "out"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    assert "larger than the system allows" in told


def test_closed_streams_change_nothing(finished: Path, boxes: str) -> None:
    before = (finished / "results.csv").read_bytes()
    (finished / "results.csv").unlink()
    command = f'exec "{sys.executable}" -m benchmarks.cli run "{boxes}" --out "{finished}" <&- >&- 2>&-'
    assert subprocess.run(command, shell=True, check=False).returncode == arguments.DONE
    assert (finished / "results.csv").read_bytes() == before


def test_progress_goes_on_when_its_reader_has_left() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream:
        progress = Progress("cells", 2, expected_s=1.0, workers=1, stream=stream)
        progress.finish("one")
        progress.finish("two")
        assert progress.finished == 2 and progress.stream.fileno() == writing


def test_unusable_shared_memory_is_called_that(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, capture: Path
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(multiprocessing.context.BaseContext, "Lock", refuse)
    monkeypatch.setattr("ash.capture.manifest.read_manifest", refuse)
    assert refused(capsys, "verify", str(capture)).startswith("ash-bench: /dev/shm: cannot be used")
    monkeypatch.undo()
    monkeypatch.setattr("ash.capture.manifest.read_manifest", refuse)
    assert "the file system is read-only" in refused(capsys, "verify", str(capture))


def test_a_format_with_a_slash_is_refused(capsys: pytest.CaptureFixture[str], capture: Path) -> None:
    assert "got 'a/b'" in refused(capsys, "export", str(capture), "--format", "a/b")


@pytest.mark.parametrize("command", [("play",), ("export", "--format", "html"), ("export", "--format", "ply")])
def test_code_of_others_is_not_loaded_untrusted(finished: Path, capsys, command: tuple[str, ...]) -> None:
    message = refused(capsys, *command, str(next((finished / "cells").iterdir())))
    assert "is not ours" in message and "--trust" in message
