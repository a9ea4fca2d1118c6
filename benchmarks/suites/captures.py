"""The captures that a suite needs, made or taken up where they lie."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ash.capture.formats import load_capture
from ash.capture.manifest import Manifest, is_capture, read_manifest, verify_capture
from ash.files import InputError, file_lock, hash_of
from benchmarks.suites.scenes import SPLATS, draw_scene, identity_of, scene_of
from benchmarks.suites.stress import Stress
from benchmarks.suites.suites import CaptureSpec, Suite
from synth.cost import require_space
from synth.person.cast import VALIDATION
from synth.perturbation.perturb import perturb
from synth.scene import Scene

# Versions of `synth` (`Manifest.source`) by which captures of equal parameters show the same, the later first. The
# first changes the parameters of size `factor` and of scene `lit`. The last differs in `body.npz` alone, whose faces
# were those of other vertices: rows on the bare body, `smpl` and `neural_actor`, have to be trained again.
SHOWS_THE_SAME = {"1601aa1599046f1e": "d76a8f261fee1ea7", "2604a07c00b0b2df": "d76a8f261fee1ea7"}


def make_capture(spec: CaptureSpec, data: Path, *, workers: int) -> Path:
    """The folder of a finished capture under `data`, rendering what is missing of it.

    A capture that an older version of the scene left under the same name is not touched: the new one goes beside it.
    """
    if spec.stress is not None:
        return _perturbed_capture(
            spec, spec.stress, make_capture(replace(spec, stress=None), data, workers=workers), data
        )
    folder = capture_folder(spec, data)
    if spec.folder is None:
        make_capture_in(spec, folder, workers=workers)
    return folder


def capture_folder(spec: CaptureSpec, data: Path) -> Path:
    """Where an unperturbed capture lies, or will."""
    if spec.folder is not None:
        return spec.folder
    folder = data / spec.name
    identity = identity_of(spec.of or spec.scene, described(spec))
    if is_capture(folder) and read_manifest(folder).identity not in ("", identity):
        return data / f"{spec.name}-{identity[:8]}"
    return folder


def missing_captures(suite: Suite, data: Path) -> list[CaptureSpec]:
    """The captures that a run has to render first."""
    clean = (spec for spec in suite.captures if spec.folder is None and spec.stress is None)
    return [spec for spec in clean if not is_capture(capture_folder(spec, data))]


def require_space_for(missing: Sequence[CaptureSpec], data: Path) -> None:
    """Refuse captures that the disk cannot hold together."""
    require_space(
        [(described(spec), capture_folder(spec, data)) for spec in missing if (spec.of or spec.scene) != SPLATS], data
    )


def described(spec: CaptureSpec) -> Scene:
    """The scene of a capture that is to be made."""
    of, who = spec.of or spec.scene, spec.subject
    return scene_of(of, size=spec.size, seed=spec.seed, subject=who, name=spec.scene, changes=spec.changes)


def _perturbed_capture(spec: CaptureSpec, stress: Stress, clean: Path, data: Path) -> Path:
    """The clean capture, perturbed; made anew where an earlier attempt did not come to its manifest, the last file."""
    capture = load_capture(clean)
    folder = data / f"{spec.name}-{capture.identity[:8]}"
    with file_lock(folder):  # Shards may want it at once.
        if not is_capture(folder):
            shutil.rmtree(folder, ignore_errors=True)
            perturb(clean, folder, stress.perturbation(capture), seed=spec.seed)
    return folder


def make_capture_in(spec: CaptureSpec, folder: Path, *, workers: int) -> None:
    """Render into `folder` what is missing of a capture."""
    draw_scene(spec.of or spec.scene, described(spec), folder, title=spec.name, workers=workers)


def require_intact(folder: Path) -> None:
    """Hash a capture again before anything is learned from it.

    Raises:
        InputError: a file is missing, altered or foreign; names the first.
    """
    problems = verify_capture(folder)
    if problems:
        more = f" (and {len(problems) - 1} more, see ash-bench verify)" if len(problems) > 1 else ""
        raise InputError(f"{folder}: {problems[0]}{more}")


def subject_of(manifest: Manifest) -> int:
    """Whom a capture shows; captures from before there were others show subject 0."""
    number = manifest.parameters.get("subject", 0)
    if not isinstance(number, int):
        raise InputError(f"capture of {manifest.scene}: subject {number!r}, expected a whole number")
    return number


def require_kept_apart(suite: Suite) -> None:
    """Refuse captures for validation and tuning, and where the suite is there to choose by, people of the tables.

    What was tuned on a capture may not be judged by it.

    Raises:
        InputError: a finished capture has a subject or a root seed from 100 on, or for choosing, a subject below.
    """
    for spec in suite.captures:
        if spec.folder is None:
            continue
        manifest = read_manifest(spec.folder)
        subject, seed = subject_of(manifest), manifest.seed
        if suite.validation and subject < VALIDATION:
            raise InputError(
                f"{spec.folder}: subject {subject} is for tables, expected one from {VALIDATION} on to choose by"
            )
        for what, number in (("subject", subject), ("seed", seed)):
            if number >= VALIDATION and not suite.validation:
                raise InputError(
                    f"{spec.folder}: {what} {number} is for validation and tuning, expected one below {VALIDATION}"
                )


def truth_of(manifest: Manifest) -> str:
    """A name for what a capture shows that does not depend on the machine that rendered it."""
    source = SHOWS_THE_SAME.get(manifest.source, manifest.source)
    return hash_of([manifest.identity or None, source or None, _perturbation(manifest)])


def recipe_of(manifest: Manifest) -> str:
    """A name for what decides a capture but its subject."""
    parameters = {name: value for name, value in manifest.parameters.items() if name != "subject"}
    return hash_of([manifest.size, manifest.seed, parameters, _perturbation(manifest)])


def _perturbation(manifest: Manifest) -> dict[str, Any]:
    return {name: value for name, value in manifest.perturbed.items() if name != "of"}
