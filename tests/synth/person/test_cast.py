"""Subjects: who a number stands for, how they are baked, dressed and painted."""

import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from ash.files import InputError
from synth import presets
from synth.person import anny_body, cast, texture
from synth.person.body import PARTS
from synth.person.cast import BLOCK, FIRST, MOST, VALIDATION, Print, Shape, subject
from synth.person.dressing import EYES, FOOT, LEG, SLIT, Measures, _past_sleeve, _skirt
from synth.person.mannequin import mannequin
from synth.person.prints import PATTERNS, printed
from synth.person.tubes import lattice
from synth.scene import stream
from synth.skeleton import JOINTS

CAST = [subject(number) for number in range(100)]
# Every 13th texel of subject 0's mannequin in a skirt, painted at 64 texels with seed 5 before there were others.
PAINTED = [
    [187, 180, 162], [187, 179, 161], [58, 35, 20], [44, 26, 15], [72, 43, 25], [75, 93, 135], [77, 95, 138],
    [51, 69, 92], [208, 157, 127], [49, 49, 56], [48, 64, 86], [132, 82, 73], [49, 66, 88], [86, 101, 138],
    [87, 103, 140], [52, 70, 93], [54, 73, 97], [53, 72, 95], [79, 97, 142], [78, 96, 141], [80, 38, 38], [131, 24, 33],
    [137, 25, 35], [95, 34, 37], [211, 206, 197],
]  # fmt: skip


def test_subject_0_is_painted_as_before_there_were_others():
    image = texture.paint(mannequin(skirt=True), size=64, seed=5)
    np.testing.assert_allclose(image[5::13, 5::13].reshape(-1, 3).astype(int), PAINTED, atol=1)
    assert np.array_equal(image, texture.paint(mannequin(skirt=True), size=64, seed=5, subject=subject(0)))


def test_subject_0_has_the_body_and_the_scene_that_there_were():
    shape = {"gender": 0.0, "age": 0.5, "muscle": 0.55, "weight": 0.42, "height": 0.55, "proportions": 0.7}
    assert subject(0).shape.phenotypes == shape
    scene = presets.scene("loose", size="ci")
    assert "subject" not in scene.parameters
    assert scene == presets.scene("loose", size="ci", subject=0)


def test_a_subject_follows_from_its_number_alone_and_is_part_of_the_scene():
    cast.subject.cache_clear()
    assert [subject(number) for number in reversed(range(100))] == CAST[::-1]
    scenes = [presets.scene("loose", size="ci", subject=number) for number in (0, 3, 4)]
    assert len({scene.identity for scene in scenes}) == 3 and scenes[1].parameters["subject"] == 3
    assert len({stream(scene, "motion") for scene in scenes}) == 3


def test_subjects_differ_in_body_head_and_every_garment():
    for part in ("shape", "head", "shirt", "trousers", "skirt"):
        assert len({getattr(person, part) for person in CAST}) == len(CAST), part


def test_people_for_validation_have_other_bodies_and_clothes_than_those_of_tables():
    tables, validation = CAST[:32], [subject(number) for number in range(VALIDATION, VALIDATION + 12)]
    for part in ("shape", "head", "shirt", "trousers", "skirt"):
        assert not {getattr(person, part) for person in tables} & {getattr(person, part) for person in validation}, part
    kinds = {person.loose.skirt.kind for person in validation}
    assert kinds == {person.loose.skirt.kind for person in CAST}, "all kinds of loose clothes"


def test_a_block_covers_the_range_of_every_trait():
    for start in (16, 48, 1600):
        people = [subject(number) for number in range(start, start + BLOCK)]
        assert sum(person.shape.gender > 0.5 for person in people) == BLOCK / 2
        heights = sorted(person.shape.height for person in people)
        np.testing.assert_allclose(heights, np.linspace(0.3, 0.48, BLOCK), atol=0.18 / BLOCK)
        periods = [cloth.period for person in people for cloth in (person.shirt.cloth, person.skirt.cloth)]
        assert min(periods) < 0.0065 and max(periods) > 0.08
        contrasts = [np.abs(np.subtract(*person.shirt.cloth.colours[:2])).max() for person in people]
        assert min(contrasts) < 0.12 and max(contrasts) > 0.4


def test_subjects_are_adults_of_ordinary_proportions_in_real_colours():
    for person in CAST[1:]:
        shape = person.shape
        assert 0.64 <= shape.age <= 0.84 and min(shape.gender, 1 - shape.gender) < 0.13
        assert all(0.3 <= value < 0.86 for value in (shape.muscle, shape.weight, shape.height, shape.proportions))
        assert sum(shape.descent) == pytest.approx(1, abs=2e-3)
        for cloth in (person.shirt.cloth, person.trousers.cloth, person.skirt.cloth):
            assert cloth.kind in PATTERNS and 0.005 <= cloth.period <= 0.1
        numbers = np.array([colour for colour in _colours(asdict(person)) if colour is not shape.descent])
        assert len(numbers) > 20 and numbers.min() >= 0 and numbers.max() <= 1


def _colours(value) -> list[tuple[float, ...]]:
    if isinstance(value, dict):
        return [colour for name, inner in value.items() if name != "descent" for colour in _colours(inner)]
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return [value]
    return [colour for inner in value for colour in _colours(inner)] if isinstance(value, tuple) else []


@pytest.mark.parametrize("number", [-1, MOST + 1])
def test_other_numbers_are_refused(number: int):
    with pytest.raises(InputError, match="expected 0 to"):
        subject(number)
    with pytest.raises(InputError, match="expected 0 to"):
        presets.scene("loose", size="ci", subject=number)


def test_subjects_are_painted_in_their_own_colours():
    body = mannequin(skirt=True)
    images = [texture.paint(body, size=64, seed=5, subject=CAST[number]).astype(int) for number in (0, 1, 2)]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (np.abs(images[one] - images[other]).max(axis=-1) > 8).mean() > 0.6
    texels = texture.locate(body, 64)
    shoes = body.surface.part[texels.face] == PARTS.index("shoes")
    painted = images[1][texels.rows[shoes], texels.columns[shoes]] / 255
    assert np.abs(np.median(painted, axis=0) - CAST[1].shoes.leather).max() < 0.1


@pytest.mark.parametrize("kind", sorted(PATTERNS))
def test_a_print_repeats_and_keeps_to_its_colours(kind: str):
    cloth = Print(kind=kind, period=0.02, colours=((0.1, 0.2, 0.3), (0.9, 0.8, 0.7), (0.5, 0.1, 0.1)))
    along, around = (side.ravel() for side in np.meshgrid(np.linspace(0, 0.1, 61), np.linspace(0, 0.2, 83)))
    colours = printed(cloth, around, along)
    assert colours.min() >= 0.1 and colours.max() <= 0.9
    shares = (np.abs(colours - cloth.colours[0]).max(axis=1) > 0.2).mean()
    assert shares == 0 if kind == "plain" else 0.1 < shares < 0.9
    # Leaves turn with every second row and step aside with each: they come back after 100 rows.
    again = {"leaves": 100, "dots": 2}.get(kind, 1) * cloth.period
    np.testing.assert_allclose(printed(cloth, around, along + again), colours, atol=1e-6)


def _baked(scale: float) -> dict[str, np.ndarray]:
    names = [name for name, _ in JOINTS]
    heads = np.zeros((len(names), 3))
    heads[names.index("thigh_left")] = [0.1, scale * LEG, 0]
    heads[names.index("toe_left")] = [0.1, 0, scale * FOOT]
    for side, sign in (("left", 1), ("right", -1)):
        heads[names.index(f"upper_arm_{side}")] = [0.2 * sign, 1.4, 0]
        heads[names.index(f"hand_{side}")] = [0.5 * sign, 1.4, 0]
    return {"heads": heads, "eyes": EYES + np.array([[0.03, scale - 1, 0], [-0.03, scale - 1, 0]])}


def test_a_body_is_measured_to_a_thousandth():
    for scale in (1.0, 1.0003, 0.9, 1.1):
        measures = Measures.of(_baked(scale))
        assert measures.leg == measures.foot == round(scale, 3)
        np.testing.assert_allclose(measures.head, [0, round(scale - 1, 3), 0], atol=1e-9)


def test_a_short_sleeve_ends_on_the_arm():
    points = np.array([[0.3, 1.4, 0], [0.4, 1.4, 0], [-0.4, 1.4, 0], [0.1, 1.2, 0.1]])
    short = replace(FIRST, shirt=replace(FIRST.shirt, sleeve=0.4))
    np.testing.assert_array_equal(_past_sleeve(points, _baked(1.0), short), [False, True, True, False])
    assert not _past_sleeve(points, _baked(1.0), FIRST).any()


def test_skirts_are_as_long_and_as_full_as_they_are_told():
    angle = 2 * np.pi * np.arange(24) / 24
    rings = [
        np.stack([0.15 * np.sin(angle), 0 * angle + y, 0.12 * np.cos(angle)], 1) for y in np.arange(0.2, 1.1, 0.02)
    ]
    trunk = np.concatenate(rings)
    plain, long, full, tall = (
        _skirt(trunk, replace(FIRST.skirt, **changes), leg, yoke=1.2)
        for changes, leg in (({}, 1.0), ({"length": 0.62}, 1.0), ({"fullness": 1.5}, 1.0), ({}, 0.9))
    )
    assert plain.knots[0, 1] == 0.52 and plain.knots[-1, 1] == 1.01 and plain.rings == 20
    assert long.knots[0, 1] == pytest.approx(0.39) and long.rings == 25
    assert full.radii[0, 0] - plain.radii[0, 0] == pytest.approx(0.5 * 0.115)
    np.testing.assert_allclose(tall.knots[:, 1], 0.9 * plain.knots[:, 1])


def test_garments_of_a_block_are_of_every_kind_alike_and_subject_0_keeps_its_skirt():
    assert FIRST.skirt.kind == "skirt" and FIRST.loose is FIRST
    for start in (16, 48):
        kinds = [subject(number).skirt.kind for number in range(start, start + BLOCK)]
        assert all(kinds.count(kind) == BLOCK / len(cast.GARMENTS) for kind in cast.GARMENTS)
    for person in CAST[1:]:
        worn, garment = person.loose, person.skirt
        if garment.kind == "skirt":
            assert worn == person
            continue
        assert worn.shirt.cloth == garment.cloth and worn.shirt.words is None
        assert (worn.shirt.buttons is not None) == (garment.kind == "coat") and person.shirt.buttons is None
        assert replace(worn, shirt=person.shirt) == person
    lengths = {kind: [p.skirt.length for p in CAST[1:] if p.skirt.kind == kind] for kind in cast.GARMENTS}
    assert max(lengths["smock"]) < min(lengths["dress"]) and min(lengths["coat"]) > 0.45


def test_dresses_and_smocks_hang_from_the_chest_and_a_coat_is_open_in_front():
    angle = 2 * np.pi * np.arange(24) / 24
    levels = np.arange(0.2, 1.3, 0.02)
    girth = 1 - 0.3 * np.exp(-(((levels - 1.05) / 0.08) ** 2))  # a waist
    across = np.stack([0.15 * np.sin(angle), 0.12 * np.cos(angle)], axis=1)
    trunk = np.concatenate([np.insert(g * across, 1, y, axis=1) for y, g in zip(levels, girth, strict=True)])
    tubes = {kind: _skirt(trunk, replace(FIRST.skirt, kind=kind), 1.0, yoke=1.22) for kind in cast.GARMENTS}
    tops = {kind: tube.knots[-1, 1] for kind, tube in tubes.items()}
    assert tops == {"skirt": 1.01, "dress": 1.22, "coat": 1.01, "smock": 1.22}
    assert all(tube.knots[0, 1] == 0.52 for tube in tubes.values())
    waist = {kind: tubes[kind].radii[5, 0] for kind in ("dress", "smock")}
    assert waist["smock"] > 0.16 > waist["dress"]  # A smock falls past the waist, a dress follows it.
    assert (np.diff(tubes["smock"].radii[:, 0]) <= 1e-12).all()
    assert tubes["coat"].slit > 0 == tubes["skirt"].slit
    place, along = lattice(tubes["coat"], 20, 56)
    gap = np.linalg.norm(place[:, 0] - place[:, -1], axis=1)
    assert place[:, [0, -1], 2].min() > 0 and gap[0] > 3 * gap[along > SLIT].max()


def test_a_block_of_bodies_is_baked_by_two_models_and_what_is_there_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made: list[str] = []
    anny, models, legacy = ModuleType("anny"), ModuleType("anny.models"), ModuleType("anny.models.legacy")
    models.full_model = SimpleNamespace()  # type: ignore[attr-defined]
    anny.create_fullbody_model = lambda: made.append("reduced")  # type: ignore[attr-defined]
    anny.Anny = lambda **options: made.append(options["phenotypes"])  # type: ignore[attr-defined]
    legacy.legacy_rig_to_anny = legacy.legacy_topology_to_anny = lambda *names: SimpleNamespace()  # type: ignore[attr-defined]
    for name, module in (("anny", anny), ("anny.models", models), ("anny.models.legacy", legacy)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setenv("ASH_BENCH_CACHE", str(tmp_path))
    shapes: list[Shape] = []
    monkeypatch.setattr(anny_body, "_baked", lambda model, shape: shapes.append(shape) or {"heads": np.zeros(3)})
    anny_body._bake(5)
    assert shapes == [FIRST.shape, subject(5).shape, *(subject(k).shape for k in range(1, BLOCK) if k != 5)]
    assert made == ["reduced", "all"] and len(list(tmp_path.glob("body-*.npz"))) == BLOCK
    anny_body._path(subject(3).shape).unlink()
    anny_body._bake(3)
    assert shapes[BLOCK:] == [subject(3).shape] and made == ["reduced", "all", "all"]
