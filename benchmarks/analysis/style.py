"""Titles and colours of methods in tables and charts; a method of a third party keeps its own name."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache

from ash.files import hash_of
from benchmarks.cell.registry import DECIDING_PACKAGES, methods
from benchmarks.cell.schema import CellConfig
from benchmarks.suites.files import our_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodStyle:
    """A method's title and its colour, readable on white and on dark pages."""

    title: str
    colour: str
    reference: str = "ash"  # what it is compared with


@dataclass(frozen=True, kw_only=True, slots=True)
class SplitName:
    """The title of a split above a column, and its name in a sentence."""

    title: str
    words: str


ADDED = (  # by `ash_plus`: name, title, colour
    ("base", "static texels", "#5b8c2a"),
    ("light", "light", "#b8860b"),
    ("standardise", "standardised textures", "#c2415c"),
    ("heading", "heading normalised", "#8d6e63"),
    ("anchor", "texels on triangles", "#a0522d"),
    ("background", "random background", "#2a9d8f"),
    ("loss", "more L1 in the loss", "#9b59b6"),
    ("dilation", "less dilation", "#008fb3"),
    ("matt", "SH 0", "#7a869a"),
    ("coarse", "one coarse U-Net", "#dd6b20"),
    ("narrow", "half the width, one frame", "#5b6b7a"),
)
STYLES = {
    "ash": MethodStyle(title="ASH", colour="#2f6fde"),
    "ash_plus": MethodStyle(title="ASH+", colour="#12b5cb"),
    "ash_truth": MethodStyle(title="ASH, exact surface", colour="#2f6fde"),
    "ddc": MethodStyle(title="DDC", colour="#dd6b20"),
    "ddc_plus": MethodStyle(title="DDC+", colour="#e5a500", reference="ash_plus"),
    "ddc_truth": MethodStyle(title="DDC, exact surface", colour="#dd6b20"),
    "wo_disp": MethodStyle(title="w/o disp.", colour="#2a9d8f"),
    "wo_mot": MethodStyle(title="w/o mot.", colour="#9b59b6"),
    "wo_mot_plus": MethodStyle(title="ASH+ w/o mot.", colour="#c77dff", reference="ash_plus"),
    "wo_mot_truncated": MethodStyle(title="w/o mot., 40 s of footage", colour="#7a869a"),
    "res_128": MethodStyle(title="half texels", colour="#5b8c2a"),
    "double_width": MethodStyle(title="ASH+, double width", colour="#9b59b6", reference="ash_plus"),
    "half_width": MethodStyle(title="ASH+, half width", colour="#c2415c", reference="ash_plus"),
    "half_texels": MethodStyle(title="ASH+, half texels", colour="#5b8c2a", reference="ash_plus"),
    "half_texels_and_width": MethodStyle(title="ASH+, half texels and width", colour="#008fb3", reference="ash_plus"),
    "double_texels": MethodStyle(title="ASH+, double texels", colour="#a0522d", reference="ash_plus"),
    "res_512": MethodStyle(title="double texels", colour="#008fb3"),
    "cams_12": MethodStyle(title="1/10 of cameras", colour="#a0522d"),
    "cams_30": MethodStyle(title="1/4 of cameras", colour="#b8860b"),
    "cams_60": MethodStyle(title="1/2 of cameras", colour="#7a869a"),
    "window_1": MethodStyle(title="window 1", colour="#008fb3"),
    "unlearned": MethodStyle(title="skinned template", colour="#b8860b"),
    "wo_phi": MethodStyle(title="w/o Phi", colour="#c2415c"),
    "plus_window_3": MethodStyle(title="ASH+, window 3", colour="#7a869a", reference="ash_plus"),
    "wo_phi_and_light": MethodStyle(title="ASH+ w/o Phi and light", colour="#5b8c2a", reference="ash_plus"),
    "sh_0": MethodStyle(title="SH 0", colour="#008fb3"),
    "sh_1": MethodStyle(title="SH 1", colour="#a0522d"),
    "sh_2": MethodStyle(title="SH 2", colour="#7a869a"),
    "mlp": MethodStyle(title="w/ MLP", colour="#c2415c"),
    "mlp_base": MethodStyle(title="w/ MLP on learned texels", colour="#a0522d"),
    "smpl": MethodStyle(title="bare-body template", colour="#8d6e63"),
    "tava": MethodStyle(title="TAVA", colour="#c2415c"),
    "neural_actor": MethodStyle(title="Neural Actor", colour="#5b8c2a"),
    "hdhumans": MethodStyle(title="HDHumans", colour="#9b59b6"),
    "per_frame": MethodStyle(title="Gaussians per training frame", colour="#7a869a", reference="ash_plus"),
    # Suite `switches`.
    "warm_up_released": MethodStyle(title="warm-up as released", colour="#7a869a"),
    "warm_up_none": MethodStyle(title="no warm-up", colour="#b8860b"),
    "loss_released": MethodStyle(title="loss as released", colour="#c2415c"),
    "norm_released": MethodStyle(title="batch norm as released", colour="#5b8c2a"),
    "norm_instance": MethodStyle(title="instance norm", colour="#b8860b"),
    "world_rotations": MethodStyle(title="world-frame rotations", colour="#008fb3"),
    "released_phi": MethodStyle(title="Phi as released", colour="#a0522d"),
    "offset_in_metres": MethodStyle(title="offset in metres", colour="#9b59b6"),
    "constant_rate": MethodStyle(title="constant learning rate", colour="#c2415c"),
    "noisy_textures": MethodStyle(title="ASH+, noise on textures", colour="#7a869a", reference="ash_plus"),
    "last_weights": MethodStyle(title="no weight averaging", colour="#a0522d"),
    # Suite `plus`: one addition to `ash`, and all up to one.
    **{f"plus_{name}": MethodStyle(title=f"+ {title}", colour=colour) for name, title, colour in ADDED},
    **{f"to_{name}": MethodStyle(title=f"up to {title}", colour=colour) for name, title, colour in ADDED},
    # Rows that differ in what the template is learned from.
    "by_scans": MethodStyle(title="template from scans", colour="#2a9d8f"),
    "ddc_by_scans": MethodStyle(title="DDC, template from scans", colour="#b8860b"),
    "by_graph": MethodStyle(title="graph-network template", colour="#a0522d"),
    "refined": MethodStyle(title="photometrically refined template", colour="#c2415c"),
    "static": MethodStyle(title="static", colour="#7a869a"),
    "nearest": MethodStyle(title="nearest image", colour="#7a869a"),
    "oracle_texture": MethodStyle(title="best texture, exact mesh", colour="#b8860b"),
}
SPLIT_NAMES = {
    "novel_view": SplitName(title="Novel view", words="novel views"),
    "near_pose": SplitName(title="Novel pose: near", words="near novel poses"),
    "novel_pose": SplitName(title="Novel pose: new", words="novel poses"),
    "far_pose": SplitName(title="Novel pose: far", words="far novel poses"),
    "train_view": SplitName(title="Training view", words="training views"),
    "speed": SplitName(title="Cost", words="cost"),
    "memory": SplitName(title="Cost", words="cost"),
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
    return MethodStyle(title=titles.get(method, title), colour=SPARE_COLOURS[sum(method.encode()) % len(SPARE_COLOURS)])


def reference_of(method: str, methods: Collection[str]) -> str | None:
    """Which of the methods of a run a method is compared with: ASH or ASH+, of its own pair first; None: neither."""
    first = STYLES[method].reference if is_ours(method) and method in STYLES else REFERENCES[0]
    known = [name for name in (first, *REFERENCES) if name in methods and name != method]
    return known[0] if known else None


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
