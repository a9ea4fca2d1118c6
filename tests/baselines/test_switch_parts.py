"""Every switch, every row and every field changes what it names, and nothing else.

What each may change is written down here, by hand; all other parts (`helpers.parts`) must be, bit for bit, those of
the avatar without the change. A field that has no case, no row and no test of its own fails.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from helpers.captures import tiny_preset, write_tube_capture
from helpers.figures import tube_mesh
from helpers.parts import differing, fingerprints

from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose, scan_path
from ash.fields import apply_overrides, changed, flat
from ash.files import write_arrays
from ash.presets import ADDITIONS
from ash.template.template import skinned_template
from ash.template_learning import tracking
from baselines.ddc import DdcAvatar, ddc, ddc_plus
from benchmarks.cell.registry import configured, find_method, offered
from benchmarks.suites.files import find_suite

Parts = dict[str, str]
Changes = Mapping[str, Any]
Apart = Callable[[str, Changes], Parts]
METHODS: dict[str, Any] = {"ash": presets.ash, "ash_plus": presets.ash_plus, "ddc": ddc, "ddc_plus": ddc_plus}
BULGE_M = 0.01  # of the true surface where the tube is straight, and as much more per radian


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The tube with a bulge that follows its bend: there is something to learn for a template that sees the truth.

    What templates are learned from is tracked once for all avatars.
    """
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    rest, posed = tube_mesh().vertices, []
    for frame, dofs in enumerate(made.motion.dofs):
        bulged = torch.from_numpy(rest + (1 + dofs[6]) * BULGE_M * rest * [1, 0, 1] / 0.1).float()
        posed.append(skinned_template(made).pose(Pose(made.motion, frame)).transforms.apply(bulged).numpy())
    write_arrays(made.folder / "truth" / "template.npz", vertices=np.stack(posed))
    for frame in made.splits["train"].frames:
        write_arrays(scan_path(made.folder, frame), vertices=posed[frame], faces=tube_mesh().faces)
    return replace(made, store=tmp_path_factory.mktemp("store"))


@pytest.fixture(autouse=True, scope="module")
def tiny() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "SCAN_RIM", 0)  # The tube is open at its ends, and its scans are exact there.
        patch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=10, warmup_steps=15))
        yield


@pytest.fixture(scope="module")
def apart(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Apart:
    """The parts of a method with some fields changed; each avatar is made once."""

    @cache
    def made(method: str, changes: tuple[tuple[str, Any], ...]) -> Parts:
        config = apply_overrides(METHODS[method].config("ci"), changes, of=method)
        avatar = METHODS[method](capture, seed=config.seed, preset="ci", config=config)
        return fingerprints(avatar, capture, tmp_path_factory.mktemp("apart"))

    return lambda method, changes: made(method, tuple(sorted(changes.items())))


DECODERS = {"decoding", "weights"}
SURFACE = {"template", "places", "start", "textures"}  # the template, and all that is drawn from it
SWITCHES = {row.name: row for row in find_suite("switches").methods if row.changes}
CHANGED_BY_SWITCH = {
    "warm_up_released": {"warm_up"},
    "warm_up_none": {"warm_up"},
    "loss_released": {"loss"},
    "norm_released": DECODERS,
    "norm_instance": DECODERS,
    "world_rotations": {"posing"},
    "released_phi": DECODERS,
    "wo_phi": DECODERS,
    "sh_0": DECODERS | {"spread"},
    "offset_in_metres": {"posing"},
    "metres_no_warm_up": {"posing", "warm_up"},
    "noisy_textures": {"noise"},
    "last_weights": {"average"},
    "constant_rate": {"course"},
}


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_changes_what_it_names_and_nothing_else(name: str, apart: Apart) -> None:
    row = SWITCHES[name]
    assert differing(apart(row.of, {}), apart(row.of, dict(row.changes))) == CHANGED_BY_SWITCH[name]


CHANGED_BY_ADDITION = {
    "base": {"start", "rates", "warm_up"},
    "light": {"light", "rates"},
    "standardise": {"textures"},
    "heading": {"textures"},
    "background": {"batches"},
    "loss": {"loss"},
    "dilation": {"drawing"},
    "matt": DECODERS | {"spread"},
    "coarse": DECODERS | {"textures"},
    "narrow": DECODERS | {"textures"},
}


@pytest.mark.parametrize("name", ADDITIONS)
def test_an_addition_changes_what_it_names_and_nothing_else(name: str, apart: Apart) -> None:
    assert differing(apart("ash", {}), apart("ash", ADDITIONS[name])) == CHANGED_BY_ADDITION[name]


@pytest.mark.parametrize("name", ADDITIONS)
def test_the_rows_of_the_suite_add_one_or_leave_one_out(name: str) -> None:
    changes = {row.name: row.changes for row in find_suite("plus").methods}
    added, left_out = apply_overrides(presets.cpu(), ADDITIONS[name], of=name), presets.plus("cpu", without=name)
    assert configured("ash", "cpu", changes[f"plus_{name}"]) == added
    assert configured("ash_plus", "cpu", changes[f"without_{name}"]) == left_out


CAMERAS = {"batches"}
NO_MOTION = DECODERS | {"textures", "rates", "warm_up"}  # no decoders, nothing that they would see
STATIC = NO_MOTION | {"start"}  # `ash` learns no texels, but for this.
LATTICE = {"places", "start", "textures", "decoding", "posing"}  # other texels: all that is one per texel
CHANGED_BY_ROW = {
    "wo_disp": {"posing"},
    "wo_mot": STATIC,
    "wo_mot_plus": NO_MOTION,
    "wo_mot_truncated": STATIC,  # The capture is shorter than 40 s.
    "mlp": DECODERS | {"precision"},
    "mlp_base": DECODERS | {"precision", "start", "rates", "warm_up"},
    "res_128": LATTICE,
    "res_512": LATTICE,
    "cams_12": CAMERAS,
    "cams_30": CAMERAS,
    "cams_60": CAMERAS,
    "ash_truth": SURFACE | {"deformation"},
    "ddc_truth": {"template", "textures", "deformation", "refinement", "pulls", "rates"},  # Exact: it is not moved.
}


@pytest.mark.parametrize("name", CHANGED_BY_ROW)
def test_a_row_changes_what_it_names_and_nothing_else(
    name: str, capture: Capture, tmp_path: Path, apart: Apart
) -> None:
    seen = capture if name.endswith("truth") else capture.training_only()
    made = fingerprints(find_method(name).load()(seen, seed=0, preset="ci"), capture, tmp_path)
    method = ("ddc" if name.startswith("ddc") else "ash") + ("_plus" if "_plus" in name else "")
    assert differing(apart(method, {}), made) == CHANGED_BY_ROW[name]


class Case(NamedTuple):
    """Another value of a field, the parts that it may change, and what both avatars have besides so that it counts."""

    value: Any
    parts: set[str]
    on: Changes = {}  # noqa: RUF012


FITTED = {"training.warmup": "fitted"}
PLANTED = {"template.kind": "exact", "template.error_mm": 8.0}
FROM_IMAGES = {"template.kind": "learned"}
NETS = {
    "template.kind": "learned",
    "template.network": "graph",
    "template.released": True,
    "template.blocks": 1,
    "template.steps": 20,
}
MOVED = {"refine": "motion", "template.blocks": 1}
# The networks that move a template are drawn before the decoders: where they are others, so are the decoders' weights.
MOVING = {"refinement", "weights"}
OF_BOTH = {
    "seed": Case(1, {"batches", "weights"}),
    "model.window": Case(3, DECODERS | {"textures"}),
    "model.width": Case(12, DECODERS),
    "model.levels": Case(1, DECODERS),
    "model.shuffle": Case(1, DECODERS | {"textures"}),
    "model.standardise": Case(False, {"textures"}),
    "model.base": Case(False, {"start", "rates"}, {"training.warmup": "none"}),
    "training.warmup_steps": Case(5, {"warm_up"}),
    "training.learning_rate": Case(1e-3, {"rates"}),
    "training.base_learning_rate": Case(1e-3, {"rates"}),
    "training.precision": Case("bfloat16", {"precision"}, {"model.width": 16}),
}
OF_THE_LOOP = {  # Splats and mesh are fitted by one: `ash.trained_avatar`.
    "training.steps": Case(9, {"course"}),
    "training.views_per_step": Case(1, {"batches"}),
    "training.l1_weight": Case(0.5, {"loss"}),
    "training.ssim_weight": Case(0.5, {"loss"}),
    "training.background": Case("black", {"batches"}),
    "training.frames_per_step": Case(2, {"batches"}),
    "training.schedule": Case("constant", {"course"}),
    "training.crop": Case(False, {"batches"}),
    "training.seconds": Case(140.0, {"course"}),
    "training.snapshots": Case(True, {"files"}),
}
OF_ASH = {
    "model.motion": Case(False, NO_MOTION),
    "model.refine": Case(True, SURFACE | MOVING | {"rates"}),  # It starts at nothing, but for the last bit.
    "training.footage_s": Case(0.1, {"batches", "start", "textures"}),  # Standardised by what is seen.
    "template.error_mm": Case(4.0, SURFACE, PLANTED),
    "template.supervision": Case("scans", SURFACE, NETS),
    "template.network": Case("linear", SURFACE | {"deformation"}, NETS),
    "template.nodes": Case(25, SURFACE | {"deformation", "skinning"}, NETS),
    "template.window": Case(2, SURFACE | {"deformation"}, NETS),
    "template.yaw_normalise": Case(False, SURFACE, NETS),
    "template.released": Case(False, SURFACE | {"deformation", "skinning"}, NETS),
    "template.blocks": Case(2, SURFACE | {"deformation"}, NETS),
    "template.steps": Case(10, SURFACE, NETS),
}
OF_THE_MESH = {
    "texture": Case(32, DECODERS | {"start"}),
    "refine": Case("motion", MOVING | {"rates"}),
    "vertices_every": Case(2, {"pulls"}),
    "model.texels": Case(8, DECODERS | {"textures"}),
    "model.yaw_normalise": Case(False, {"textures"}),
    "model.norm": Case("instance", DECODERS),
    "model.light": Case(False, {"light", "drawing", "rates"}),
    "model.global_features": Case(False, DECODERS | {"rates"}),
    "model.global_mlp": Case("released", DECODERS),
    "training.warmup": Case("none", {"warm_up"}),
    "training.ema": Case(0.0, {"average"}),
    "training.texture_noise": Case(0.5, {"noise"}),
    "training.camera_share": Case(0.5, {"batches", "start"}),
    "training.footage_s": Case(0.1, {"batches", "start", "textures"}),
    "training.fitted_steps": Case(3, set(), FITTED),  # A mesh has no Gaussians that could be fitted.
    "template.nodes": Case(25, {"refinement"}, MOVED),
    "template.window": Case(2, MOVING, MOVED),
    "template.yaw_normalise": Case(False, {"refinement"}, MOVED),
    "template.released": Case(True, MOVING, MOVED),
    "template.blocks": Case(2, MOVING, MOVED),
}
CASES = {"ash_plus": OF_BOTH | OF_THE_LOOP | OF_ASH, "ddc_plus": OF_BOTH | OF_THE_MESH}


@pytest.mark.parametrize(("method", "name"), [(method, name) for method in CASES for name in CASES[method]])
def test_a_field_changes_what_it_names_and_nothing_else(method: str, name: str, apart: Apart) -> None:
    case = CASES[method][name]
    assert differing(apart(method, case.on), apart(method, {**case.on, name: case.value})) == case.parts


@pytest.mark.parametrize("on", [PLANTED, FROM_IMAGES, NETS], ids=["planted", "images", "nets"])
def test_the_mesh_stands_on_the_template_that_ash_gets(on: Changes, apart: Apart) -> None:
    """Whichever field of the template has another value than by default."""
    on = {**on, "model.window": 3}  # Of its textures ASH+ sees one frame, the mesh more.
    splats, mesh = apart("ash_plus", on), apart("ddc_plus", on)
    assert all(splats[part] == mesh[part] for part in ("template", "skinning", "deformation", "textures"))


ELSEWHERE = {
    "model.offset_unit_m": ("ash/test_presets.py", "test_the_offsets_unit_scales_the_offset_alone"),
    "training.fitted_steps": ("ash/training/test_warm_up.py", "test_a_fit_ends_where_nothing_is_gained"),
    "training.score_from": (
        "ash/training/test_loop.py",
        "test_views_that_are_dear_to_draw_are_scored_late_and_at_the_end",
    ),
    "device": ("ash/test_devices.py", "test_a_training_step_stays_on_its_device"),
}
ROWS_OF_ASH = [
    *(row.changes for row in SWITCHES.values()),
    *(changed(presets.ci(), offered(name, "ci")) for name in CHANGED_BY_ROW if not name.startswith("ddc")),
]
WITHOUT_A_CASE = {
    "ash_plus": {*ELSEWHERE, *(key for changes in ADDITIONS.values() for key in changes)}
    | {key for changes in ROWS_OF_ASH for key, _ in changes if len(changes) == 1},
    # Of its template: `test_the_mesh_stands_on_the_template_that_ash_gets`.
    "ddc_plus": {*OF_THE_LOOP, "training.score_from", "device"}
    | {f"template.{name}" for name in ("kind", "error_mm", "supervision", "network", "steps")},
}


@pytest.mark.parametrize("method", CASES)
def test_every_field_is_tested(method: str) -> None:
    assert AshAvatar.fit is DdcAvatar.fit and AshAvatar.loss is DdcAvatar.loss
    assert {*CASES[method], *WITHOUT_A_CASE[method]} == set(flat(METHODS[method].config("ci")))


def test_what_is_tested_elsewhere_is_there() -> None:
    for file, name in ELSEWHERE.values():
        assert f"\ndef {name}(" in (Path(__file__).parents[1] / file).read_text(), (file, name)
