"""Titles and colours of methods in tables and charts; a method of a third party keeps its own name."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import NamedTuple

from ash.files import hash_of
from benchmarks.cell.registry import DECIDING_PACKAGES, ON_EXACT, WRONG_BY_MM, methods
from benchmarks.cell.schema import CellConfig
from benchmarks.suites.files import our_rows


class MethodStyle(NamedTuple):
    """A method's title and its colour, readable on white and on dark pages."""

    title: str
    colour: str
    reference: str = "ash"  # what it is compared with


class SplitName(NamedTuple):
    """The title of a split above a column, and its name in a sentence."""

    title: str
    words: str


ADDED = (  # by `ash_plus`: name, title, colour
    ("base", "static texels", "#5b8c2a"),
    ("light", "light", "#b8860b"),
    ("standardise", "standardised textures", "#c2415c"),
    ("heading", "heading normalised", "#8d6e63"),
    ("background", "random background", "#2a9d8f"),
    ("loss", "more L1 in the loss", "#9b59b6"),
    ("dilation", "less dilation", "#008fb3"),
    ("matt", "SH 0", "#7a869a"),
    ("coarse", "one coarse U-Net", "#dd6b20"),
    ("narrow", "half the width, one frame", "#5b6b7a"),
)
MAIN = ("ash", "ddc", "wo_mot", "ash_plus", "ddc_plus", "ash_truth", "ddc_truth")
STYLES = {
    "ash": MethodStyle("ASH", "#2f6fde"),
    "ash_plus": MethodStyle("ASH+", "#12b5cb"),
    "ash_truth": MethodStyle("ASH, exact surface", "#2f6fde"),
    "ddc": MethodStyle("DDC", "#dd6b20"),
    "ddc_plus": MethodStyle("DDC+", "#e5a500", reference="ash_plus"),
    "ddc_truth": MethodStyle("DDC, exact surface", "#dd6b20"),
    "wo_disp": MethodStyle("w/o disp.", "#2a9d8f"),
    "wo_mot": MethodStyle("w/o mot.", "#9b59b6"),
    "wo_mot_plus": MethodStyle("ASH+ w/o mot.", "#c77dff", reference="ash_plus"),
    "wo_mot_truncated": MethodStyle("w/o mot., 40 s of footage", "#7a869a"),
    "res_128": MethodStyle("half texels", "#5b8c2a"),
    "double_width": MethodStyle("ASH+, double width", "#9b59b6", reference="ash_plus"),
    "half_width": MethodStyle("ASH+, half width", "#c2415c", reference="ash_plus"),
    "half_texels": MethodStyle("ASH+, half texels", "#5b8c2a", reference="ash_plus"),
    "half_texels_and_width": MethodStyle("ASH+, half texels and width", "#008fb3", reference="ash_plus"),
    "double_texels": MethodStyle("ASH+, double texels", "#a0522d", reference="ash_plus"),
    "res_512": MethodStyle("double texels", "#008fb3"),
    "cams_12": MethodStyle("1/10 of cameras", "#a0522d"),
    "cams_30": MethodStyle("1/4 of cameras", "#b8860b"),
    "cams_30_sh_0": MethodStyle("1/4 of cameras, SH 0", "#008fb3", reference="cams_30"),
    "cams_60": MethodStyle("1/2 of cameras", "#7a869a"),
    "window_1": MethodStyle("window 1", "#008fb3"),
    "unlearned": MethodStyle("skinned template", "#b8860b"),
    "wo_phi": MethodStyle("w/o Phi", "#c2415c"),
    "plus_window_3": MethodStyle("ASH+, window 3", "#7a869a", reference="ash_plus"),
    "wo_phi_and_light": MethodStyle("ASH+ w/o Phi and light", "#5b8c2a", reference="ash_plus"),
    "sh_0": MethodStyle("SH 0", "#008fb3"),
    "sh_1": MethodStyle("SH 1", "#a0522d"),
    "sh_2": MethodStyle("SH 2", "#7a869a"),
    "mlp": MethodStyle("w/ MLP", "#c2415c"),
    "mlp_base": MethodStyle("w/ MLP on static texels", "#a0522d"),
    # Suites `mlp` and `offline_stability`.
    "ash_6_min": MethodStyle("ASH, 6 min", "#2f6fde"),
    "ddc_6_min": MethodStyle("DDC, 6 min", "#dd6b20", reference="ash_6_min"),
    "tava_6_min": MethodStyle("TAVA, 6 min", "#c2415c", reference="ash_6_min"),
    "neural_actor_6_min": MethodStyle("Neural Actor, 6 min", "#5b8c2a", reference="ash_6_min"),
    "hdhumans_6_min": MethodStyle("HDHumans, 6 min", "#9b59b6", reference="ash_6_min"),
    "mlp_6_min": MethodStyle("w/ MLP, 6 min", "#c2415c", reference="ash_6_min"),
    "plus_base_6_min": MethodStyle("+ static texels, 6 min", "#5b8c2a", reference="ash_6_min"),
    "mlp_base_6_min": MethodStyle("w/ MLP on static texels, 6 min", "#a0522d", reference="plus_base_6_min"),
    "smpl": MethodStyle("bare-body template", "#8d6e63"),
    "tava": MethodStyle("TAVA", "#c2415c"),
    "neural_actor": MethodStyle("Neural Actor", "#5b8c2a"),
    "hdhumans": MethodStyle("HDHumans", "#9b59b6"),
    "tava_120_min": MethodStyle("TAVA, 120 min", "#8c2f45"),
    "neural_actor_120_min": MethodStyle("Neural Actor, 120 min", "#3f6b12"),
    "hdhumans_120_min": MethodStyle("HDHumans, 120 min", "#6d3f85"),
    "per_frame": MethodStyle("Gaussians per training frame", "#7a869a", reference="ash_plus"),
    # Suite `switches`.
    "warm_up_released": MethodStyle("warm-up as released", "#7a869a"),
    "warm_up_none": MethodStyle("no warm-up", "#b8860b"),
    "loss_released": MethodStyle("loss as released", "#c2415c"),
    "norm_released": MethodStyle("batch norm as released", "#5b8c2a"),
    "norm_instance": MethodStyle("instance norm", "#b8860b"),
    "world_rotations": MethodStyle("world-frame rotations", "#008fb3"),
    "released_phi": MethodStyle("Phi as released", "#a0522d"),
    "offset_in_metres": MethodStyle("offset in metres", "#9b59b6"),
    "metres_no_warm_up": MethodStyle("offset in metres, no warm-up", "#6d3f85"),
    "constant_rate": MethodStyle("constant learning rate", "#c2415c"),
    "noisy_textures": MethodStyle("ASH+, noise on textures", "#7a869a", reference="ash_plus"),
    "last_weights": MethodStyle("no weight averaging", "#a0522d"),
    # Suite `plus`: one addition to `ash`, and all but one.
    **{f"plus_{name}": MethodStyle(f"+ {what}", colour) for name, what, colour in ADDED},
    **{
        f"without_{name}": MethodStyle(f"ASH+ w/o {what}", colour, reference="ash_plus") for name, what, colour in ADDED
    },
    # Rows that differ in what the template is learned from.
    "by_scans": MethodStyle("template from scans", "#2a9d8f"),
    "ddc_by_scans": MethodStyle("DDC, template from scans", "#b8860b"),
    "by_graph": MethodStyle("graph-network template", "#a0522d"),
    "refined": MethodStyle("photometrically refined template", "#c2415c"),
    "static": MethodStyle("static", "#7a869a"),
    "nearest": MethodStyle("nearest image", "#7a869a"),
    "oracle_texture": MethodStyle("best texture, exact mesh", "#b8860b"),
}
# Rows that are given the exact surface with an error planted in it have the colour of those without.
STYLES |= {
    name: MethodStyle(f"{title}, surface {mm} mm off", STYLES[exact].colour)
    for mm, names in WRONG_BY_MM.items()
    for name, exact, title in zip(names, ON_EXACT, ("ASH", "DDC", "best texture"), strict=True)
    if mm > 0
}
SPLIT_NAMES = {
    "novel_view": SplitName("Novel view", "novel views"),
    "near_pose": SplitName("Novel pose: near", "near novel poses"),
    "novel_pose": SplitName("Novel pose: new", "novel poses"),
    "far_pose": SplitName("Novel pose: far", "far novel poses"),
    "train_view": SplitName("Training view", "training views"),
    "speed": SplitName("Cost", "cost"),
    "memory": SplitName("Cost", "cost"),
}
SPARE_COLOURS = ("#b8860b", "#c2415c", "#5b8c2a", "#7a869a", "#008fb3", "#a0522d")
# The two pairs that are compared: the paper's text, and both with what the paper does not have.
PAIRS = (("ash", "ddc"), ("ash_plus", "ddc_plus"))
REFERENCES = tuple(splats for splats, _ in PAIRS)
EXACT = {"ash": "ash_truth", "ddc": "ddc_truth"}  # A method and the same method given the exact surface.


_USER_ROWS: ContextVar[dict[str, str]] = ContextVar("_USER_ROWS")  # titles by name


def listed(texts: Sequence[str]) -> str:
    """A list, with semicolons where an item has a comma of its own."""
    return ("; " if any("," in text for text in texts) else ", ").join(texts)


def user_rows(configs: Iterable[CellConfig]) -> frozenset[str]:
    """Rows with a name of ours but another factory or other changes."""
    ours = our_rows()
    rows = set()
    for config in configs:
        changes = {key: value for key, value in config.changes.items() if key != "device"}
        plain = not config.factory and not changes  # the installed method itself
        if not plain and (config.method, config.source, hash_of(changes)) not in ours:
            rows.add(config.method)
    return frozenset(rows)


@contextmanager
def titles_of(configs: Iterable[CellConfig], titles: Mapping[str, str] | None = None) -> Iterator[None]:
    """In its block, `style_of` and `is_ours` give our titles to our own rows only.

    `titles`: those that the suite gives. A title that two rows share is followed by the row's name.
    """
    configs, titles = tuple(configs), titles or {}
    names = dict.fromkeys(config.method for config in configs)
    users = user_rows(configs)
    given = {
        name: titles.get(name) or (name if name in STYLES else style_of(name).title)
        for name in names
        if name in titles or name in users
    }
    token = _USER_ROWS.set(given)
    try:
        shown = [style_of(name).title for name in names]
        _USER_ROWS.set({n: title if shown.count(title) == 1 else f"{title} ({n})" for n, title in given.items()})
        yield
    finally:
        _USER_ROWS.reset(token)


def style_of(method: str) -> MethodStyle:
    """The style of a method; an unknown one gets a colour by the sum of its letters, the same in every report."""
    titles = _USER_ROWS.get({})
    if method in STYLES and method not in titles:
        return STYLES[method]
    name = method.rpartition(":")[2]
    title = name.replace("_", " ") if name != method else method  # A factory's name, where it came by its path.
    return MethodStyle(titles.get(method, title), SPARE_COLOURS[sum(method.encode()) % len(SPARE_COLOURS)])


def reference_of(method: str, methods: Collection[str]) -> str | None:
    """Which of the methods of a run a method is compared with: ASH or ASH+, of its own pair first.

    None: neither is there, or it is ASH, with which the others are compared.
    """
    if method == REFERENCES[0]:
        return None
    first = STYLES[method].reference if is_ours(method) and method in STYLES else REFERENCES[0]
    references = [name for name in (first, *REFERENCES) if name in methods and name != method]
    return references[0] if references else None


def prominence(method: str) -> int:
    """What stands first where there is no room for all rows: 0, a user's row; 1, a main one of ours; 2, another."""
    return 1 + (method not in MAIN) if is_ours(method) else 0


def is_ours(method: str) -> bool:
    """Whether the method comes with the suite, installed or as a variant that has a style here.

    A user's methods stand first in reports.
    """
    if method in _USER_ROWS.get({}):
        return False
    if ":" in method:
        return method.partition(".")[0] in DECIDING_PACKAGES
    return _installed().get(method, method in STYLES)


@cache
def _installed() -> dict[str, bool]:
    """Of each installed method, whether it is ours."""
    return {name: method.is_ours for name, method in methods().items()}
