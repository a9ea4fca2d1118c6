"""Mutants of every file that a user may bring: success, or an InputError of one line, in seconds and little memory.

`MUTANTS=10000 ./ash-bench test -- tests/fuzz` tries more; `CASES` are findings, which stay.
"""

import contextlib
import json
import os
import random
import struct
import time
import tomllib
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import safetensors.torch
import tomlkit
import torch
from helpers import fakes
from helpers.motion_files import amass_file, bvh_file

from ash.capture.formats import load_capture, read_cameras, read_motion, read_skeleton, read_template
from ash.capture.manifest import read_manifest, verify_capture
from ash.checkpoints import load_module, read_safetensors
from ash.files import InputError, read_arrays, read_image, read_json, write_image, write_json
from benchmarks.cell.evaluation import read_curve
from benchmarks.cell.lpips import _load as read_tensors
from benchmarks.cell.schema import Cell, CellConfig, failed_result, read_cell, read_result, write_config, write_result
from benchmarks.gate.baseline import GateFile, read_gate_file
from benchmarks.importing.cameras import read_colmap
from benchmarks.studies.conformance_worker import Outcome, read_outcome
from benchmarks.suites.archive import read_pack, unpacked, write_pack
from benchmarks.suites.files import read_suite
from benchmarks.suites.runs import read_run
from synth.camera.rig import rig_from_file
from synth.export.formats import export
from synth.motion.importing import import_motion, read_joint_map
from synth.person.mannequin import heads
from synth.skeleton import make_skeleton

MUTANTS = int(os.environ.get("MUTANTS", "200"))
SECONDS, MORE_MEMORY = 10.0, 64 << 20
ROOT = Path(__file__).parents[2]
Reader = Callable[[Path], object]
SKELETON = make_skeleton(heads())

NASTY = (
    None, True, -1, 0, 2**63, 1e308, -0.5, "", "../../x", "a\n\x1b[2J", "\ud800", [], {}, [[]], "x" * 5000,
    [0] * 1000, {"a": {"b": {}}},
)  # fmt: skip
CASES = (
    b"", b"{", b"[]", b"null", b"NaN", b'{"a": NaN}', b'{"a": 1e999}', b"[" * 100_000, b"\xff\xfe{}", b"\xef\xbb\xbf{}",
    b"1" * 10_000, b"\x00" * 100, b"PK\x03\x04", b"\x93NUMPY\x01\x00\xff\xff", b"HIERARCHY " + b"{ " * 100_000,
    b"HIERARCHY ROOT a { CHANNELS 6 Xposition } MOTION Frames: 1 Frame Time: 0.1 " + b"1e200 " * 6,
    b'scenes = [{ name = "a", name = "b" }]\nmethods = []\npreset = "ci"\n',
)  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Reader]]:
    """One good file of each kind, and what reads it."""
    folder = tmp_path_factory.mktemp("good")
    capture = fakes.write_capture(folder / "capture")
    joints = 3
    colmap = export(load_capture(capture), folder / "colmap", form="colmap") / "sparse" / "0"
    (folder / "joints.json").write_text('{"pelvis": "Hips", "thigh_left": "LeftUpLeg"}')
    (folder / "log.jsonl").write_text('{"seconds": 1, "loss": 2}\n{"seconds": 2, "train_psnr": 20.5}\n')
    run = folder / "run.json"
    run.write_text('{"protocol": "1", "suite": "ci", "about": "", "command": "", "cells": ["0123456789abcdef"]}')
    surface = ("faces", "uvs", "uv_faces", "part")
    return {
        "manifest": (capture / "manifest.json", lambda path: read_manifest(path.parent)),
        "cameras": (capture / "cameras.json", read_cameras),
        "skeleton": (capture / "skeleton.json", read_skeleton),
        "template": (capture / "template.npz", partial(read_template, joints=joints)),
        "motion": (capture / "motion.npz", partial(read_motion, joints=joints)),
        "surface": (capture / "truth" / "surface.npz", partial(read_arrays, expected=surface)),
        "image": (capture / "frames" / "cam0" / "000000.png", partial(read_image, shape=(64, 64, 4))),
        "bvh": (bvh_file(folder / "a.bvh"), lambda path: import_motion(path, SKELETON, fps=12.0, most=20)),
        "amass": (amass_file(folder / "a.npz"), lambda path: import_motion(path, SKELETON, fps=12.0, most=20)),
        "joint map": (folder / "joints.json", read_joint_map),
        "rig": (capture / "cameras.json", rig_from_file),
        "gate": (_gate_file(folder / "gate.json"), read_gate_file),
        "lenses": (colmap / "cameras.txt", lambda path: read_colmap(path, colmap / "images.txt")),
        "poses": (colmap / "images.txt", lambda path: read_colmap(colmap / "cameras.txt", path)),
        "curve": (folder / "log.jsonl", read_curve),
        "run": (run, lambda path: read_run(path.parent)),
        "result": (_result(folder), lambda path: read_result(path.parent)),
        "cell": (folder / "cell" / "config.json", lambda path: read_cell(path.parent)),
        "json": (run, read_json),
        "weights": (_weights(folder / "model.safetensors"), _load_weights),
        "suite": (_suite(folder / "mine.toml"), read_suite),
        "trial": (_outcome(folder / "outcome.json"), lambda path: read_outcome(path.parent)),
        "lpips": (_tensors(folder / "alex.pth"), read_tensors),
        "pack": (_pack(folder), _read_pack),
    }


def _weights(path: Path) -> Path:
    path.write_bytes(safetensors.torch.save(torch.nn.Linear(3, 2).state_dict(), metadata={"step": "3"}))
    return path


def _load_weights(path: Path) -> None:
    load_module(torch.nn.Linear(3, 2), read_safetensors(path)[0], path)


def _suite(path: Path) -> Path:
    path.write_text(
        'about = "mine"\nscenes = ["mannequin", { of = "tight", name = "swings", outfit.swing = 0.8 }]\nsize = "ci"\n'
        'methods = ["ash", { of = "ash", model.width = 8 }]\npreset = "ci"\nseeds = 2\nstresses.cameras = [25, 50]\n'
    )
    return path


def _outcome(path: Path) -> Path:
    write_json(path, asdict(Outcome(pictures=("00", "01"), again=("00",), seconds=1.5)))
    return path


def _gate_file(path: Path) -> Path:
    write_json(path, asdict(GateFile(machine="m", times={"boxes · mine": {"frame": 1.5}})))
    return path


def _tensors(path: Path) -> Path:
    torch.save({"features.0.weight": torch.ones(4, 3)}, path)
    return path


def _result(folder: Path) -> Path:
    config = CellConfig(
        scene="boxes", size="ci", capture_seed=0, capture="c", method="ash", preset="ci", seed=0, code="0"
    )
    write_config(Cell(config=config, folder=folder / "cell"))
    write_result(folder / "cell", failed_result(config, "crashed", "as an example"))
    return folder / "cell" / "result.json"


def _pack(folder: Path) -> Path:
    write_pack(read_run(folder / "cell"), folder / "mine.zip")
    return folder / "mine.zip"


def _read_pack(path: Path) -> None:
    with unpacked(path) as folder:
        read_pack(folder)
        read_run(folder)


@pytest.fixture(autouse=True)
def as_a_user_runs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the checks of shapes, which no user has: they would refuse what a reader let through, and take time."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


KINDS = (
    "manifest", "cameras", "skeleton", "template", "motion", "surface", "image", "bvh", "amass", "joint map", "rig",
    "lenses", "poses", "gate", "curve", "run", "result", "cell", "json", "weights", "suite", "trial", "lpips",
    "pack",
)  # fmt: skip


@pytest.mark.timeout(300 + MUTANTS / 10)
@pytest.mark.parametrize("kind", KINDS)
def test_mutants_are_read_or_refused_in_one_line(
    kind: str, files: dict[str, tuple[Path, Reader]], tmp_path: Path
) -> None:
    good, read = files[kind]
    whole, rng = good.read_bytes(), random.Random(kind)
    place = tmp_path / "here" / good.name
    place.parent.mkdir()
    normal = _attempt(place, whole, read)
    contents = [*CASES, *(_mutant(whole, rng) for _ in range(MUTANTS))]
    for content in contents:
        peak = _attempt(place, content, read)
        assert peak < 2 * normal + MORE_MEMORY, f"{peak >> 20} MiB"
    assert {path.name for path in tmp_path.rglob("*")} == {"here", good.name}, "nothing is written"


def _attempt(place: Path, content: bytes, read: Reader) -> int:
    """Bytes at the peak of reading."""
    _put(place, content)
    start = time.monotonic()
    tracemalloc.start()
    try:
        read(place)
    except InputError as error:
        assert str(error) and str(error).isprintable(), f"{error!r} is not one line"
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert time.monotonic() - start < SECONDS
    return peak


def _put(path: Path, content: bytes) -> None:
    """A new file each time: file systems wait for the disk where one is cut to nothing and written again."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def _mutant(whole: bytes, rng: random.Random) -> bytes:
    """By structure where the file is JSON or TOML, else by bytes, lengths in headers among them."""
    if rng.random() < 0.7:
        for read, write in ((json.loads, json.dumps), (tomllib.loads, tomlkit.dumps)):
            with contextlib.suppress(
                ValueError, TypeError
            ):  # It is of another kind, or has no word for what was put in.
                return write(_mutated(read(whole.decode()), rng)).encode()
    content = bytearray(whole)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(content))
        match rng.randrange(5):
            case 0:
                content[at] = rng.randrange(256)
            case 1:
                del content[at:]
                content += b"\0"
            case 2:
                content[at : at + 4] = struct.pack("<I", rng.choice((0, 1, 2**31 - 1, 2**32 - 1)))
            case 3:
                content[at:at] = content[max(0, at - rng.randrange(1, 64)) : at]
            case _:
                del content[at : at + rng.randrange(1, 16)]
        content = content or bytearray(b"\0")
    return bytes(content)


def _mutated(value: object, rng: random.Random) -> object:
    """The same JSON with one value, somewhere, replaced, removed or doubled."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(sorted(value))
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        if rng.random() < 0.05:
            return {**value, "unknown": 1}
        return {**value, key: _mutated(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        if rng.random() < 0.2:
            return value[:at] + value[at + 1 :] if rng.random() < 0.5 else [*value, value[at]]
        return [*value[:at], _mutated(value[at], rng), *value[at + 1 :]]
    return rng.choice(NASTY)


def test_verify_sees_every_change(tmp_path: Path) -> None:
    capture = fakes.write_capture(tmp_path / "capture")
    rng = random.Random(0)
    names = sorted(read_manifest(capture).files)
    for _ in range(min(MUTANTS, 200)):
        path = capture / rng.choice(names)
        whole = path.read_bytes()
        mutant = _mutant(whole, rng)
        _put(path, mutant)
        assert mutant == whole or verify_capture(capture)
        _put(path, whole)
    assert not verify_capture(capture)


@pytest.mark.parametrize("what", ["pipe", "device", "folder"])
def test_only_regular_files_are_read(what: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    match what:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case _:
            path.mkdir()
    arrays, image = partial(read_arrays, expected=("a",)), partial(read_image, shape=(4, 4, 4))
    for read in (read_json, arrays, image, read_suite, read_tensors):
        with pytest.raises(InputError, match="regular file"):
            read(path)


def test_a_small_archive_cannot_ask_for_much(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, a=np.zeros(1_000_000))
    with pytest.raises(InputError, match="bytes unpacked"):
        read_arrays(path, expected=("a",), most=1 << 20)


def test_a_small_image_cannot_ask_for_much(tmp_path: Path) -> None:
    """A mutant of 77 bytes made Pillow set 700 MB aside."""
    path = tmp_path / "a.png"
    write_image(path, np.zeros((64, 64, 4), np.uint8))
    content = path.read_bytes()
    at = content.index(b"IDAT") - 4
    assert _attempt(path, content[:at] + b"\x2c" + content[at + 1 :], partial(read_image, shape=(64, 64, 4))) < 1 << 20


def test_a_capture_of_mutants_is_refused_in_one_line(tmp_path: Path) -> None:
    capture = fakes.write_capture(tmp_path / "capture")
    rng = random.Random(1)
    for name in ("manifest.json", "cameras.json", "skeleton.json", "template.npz", "motion.npz"):
        path = capture / name
        whole = path.read_bytes()
        for _ in range(MUTANTS // 4):
            _put(path, _mutant(whole, rng))
            try:
                load_capture(capture)
            except InputError as error:
                assert str(error).isprintable()
        path.write_bytes(whole)
