"""The cast: which person an integer stands for. A person is a frozen description of choices; the rest follows from it.

Subject 0 is written out. The others are drawn in blocks of sixteen, each block a Latin hypercube: its subjects cover
the range of every trait evenly, and traits go together by chance only. All are adults of ordinary proportions.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

from ash.files import InputError, hash_of
from synth.person.palettes import GREY, HAIRS, IRISES, PALETTES, SKINS, Colour, Palette

Choice = TypeVar("Choice")
VALIDATION = 100  # subjects and capture seeds from here on are for validation and tuning; no table has them
MOST = 2**31 - 1
BLOCK = 16  # subjects whose traits are drawn together


@dataclass(frozen=True, kw_only=True, slots=True)
class Shape:
    """anny's phenotypes, each 0..1. The face's descent is a mixture; none given: the mean of all."""

    gender: float  # 0 male, 1 female
    age: float  # 2/3 is a young adult, 1 an old one
    muscle: float
    weight: float
    height: float
    proportions: float
    descent: Colour | None = None  # weights of african, asian, caucasian

    @property
    def phenotypes(self) -> dict[str, float]:
        """By anny's names; without a descent only what anny's standard model knows."""
        names = ("gender", "age", "muscle", "weight", "height", "proportions")
        mixed = {} if self.descent is None else dict(zip(("african", "asian", "caucasian"), self.descent, strict=True))
        return {name: getattr(self, name) for name in names} | mixed


@dataclass(frozen=True, kw_only=True, slots=True)
class Complexion:
    """Skin and hair."""

    skin: Colour
    blush: Colour
    lips: Colour
    mouth: Colour  # the line between the lips
    brow: Colour
    iris: Colour
    hair: Colour
    depth: float = 0.016  # metres that hair stands out
    nape: float = 0.98  # slope of the hairline: how low the hair reaches at the back


@dataclass(frozen=True, kw_only=True, slots=True)
class Print:
    """A pattern on cloth, `colours` of ground, figure and line; see `synth.person.prints`."""

    kind: str
    period: float  # metres
    colours: tuple[Colour, Colour, Colour]


@dataclass(frozen=True, kw_only=True, slots=True)
class Shirt:
    """A shirt, its printed words (front, back; none: plain) and how far its sleeves reach along the arm."""

    cloth: Print
    words: tuple[str, str] | None
    panel: Colour
    ink: Colour
    collar: Colour
    seam: Colour
    sleeve: float = 1.0  # of the way from shoulder to wrist; 1: to the hand
    buttons: Colour | None = None  # down the front; none: it has none


@dataclass(frozen=True, kw_only=True, slots=True)
class Trousers:
    """Trousers with a belt and a line down the outer seam."""

    cloth: Print
    line: Colour
    belt: Colour
    buckle: Colour
    cuff: float = 0.17  # height above the floor at which they end, metres on a body of subject 0's legs


@dataclass(frozen=True, kw_only=True, slots=True)
class Skirt:
    """What hangs in the loose outfit: a skirt, or what a dress, a coat or a smock is below its yoke or waist."""

    cloth: Print
    hem: Colour
    length: float = 0.49  # metres from the waist to its hem, on a body of subject 0's legs
    fullness: float = 1.0  # of subject 0's flare
    kind: str = "skirt"  # one of GARMENTS

    @property
    def is_yoked(self) -> bool:
        """Whether it hangs from the chest, not from the waist."""
        return self.kind in ("dress", "smock")


@dataclass(frozen=True, kw_only=True, slots=True)
class Shoes:
    """Colours of shoes."""

    leather: Colour
    sole: Colour
    laces: Colour
    stripes: Colour


@dataclass(frozen=True, kw_only=True, slots=True)
class Subject:
    """A person and their wardrobe."""

    number: int
    shape: Shape
    head: Complexion
    shirt: Shirt
    trousers: Trousers
    skirt: Skirt
    shoes: Shoes

    @property
    def loose(self) -> "Subject":
        """The person in the loose outfit, whose dress, coat or smock is of one cloth with what is above it."""
        garment = self.skirt
        if garment.kind == "skirt":
            return self
        coat = garment.kind == "coat"
        shirt = replace(
            self.shirt,
            cloth=garment.cloth,
            words=None,
            collar=garment.hem,
            seam=garment.cloth.colours[0],
            sleeve=1.0 if coat else self.shirt.sleeve,
            buttons=garment.hem if coat else None,
        )
        return replace(self, shirt=shirt)


WORDS = (
    ("NORTH", "1904"),
    ("RIVER", "CLUB"),
    ("ATLAS", "27"),
    ("OPEN", "STUDIO"),
    ("LUMEN", "LAB"),
    ("FIELD", "NOTES"),
)
TOPS = ("stripes", "dots", "checks", "plain", "zigzag", "leaves", "pinstripes", "tartan")
BOTTOMS = ("plain", "pinstripes", "checks", "argyle", "plain", "zigzag")
SKIRTS = ("tartan", "dots", "leaves", "stripes", "plain", "zigzag", "checks", "pinstripes")
GARMENTS = ("skirt", "dress", "coat", "smock")
COATS = ("plain", "checks", "pinstripes", "tartan")
FINEST, COARSEST = 0.005, 0.1  # metres, periods of prints
FIRST = Subject(
    number=0,
    shape=Shape(gender=0.0, age=0.5, muscle=0.55, weight=0.42, height=0.55, proportions=0.7),
    head=Complexion(
        skin=(0.82, 0.62, 0.5), blush=(0.86, 0.45, 0.4), lips=(0.7, 0.3, 0.3), mouth=(0.4, 0.15, 0.15),
        brow=(0.17, 0.1, 0.06), iris=(0.25, 0.36, 0.3), hair=(0.2, 0.12, 0.07),
    ),
    shirt=Shirt(
        cloth=Print(kind="stripes", period=0.044, colours=((0.74, 0.71, 0.64), (0.3, 0.37, 0.54), (0.3, 0.37, 0.54))),
        words=("ASH 24", "BENCH"), panel=(0.93, 0.72, 0.2), ink=(0.1, 0.08, 0.12), collar=(0.75, 0.16, 0.14),
        seam=(0.08, 0.1, 0.2),
    ),
    trousers=Trousers(
        cloth=Print(kind="argyle", period=0.05, colours=((0.2, 0.27, 0.36), (0.5, 0.5, 0.46), (0.6, 0.25, 0.2))),
        line=(0.85, 0.5, 0.15), belt=(0.25, 0.13, 0.07), buckle=(0.85, 0.78, 0.5),
    ),
    skirt=Skirt(
        cloth=Print(kind="tartan", period=0.08, colours=((0.55, 0.1, 0.14), (0.08, 0.2, 0.16), (0.72, 0.6, 0.45))),
        hem=(0.8, 0.68, 0.42),
    ),
    shoes=Shoes(leather=(0.2, 0.2, 0.23), sole=(0.88, 0.86, 0.82), laces=(0.95, 0.9, 0.85), stripes=(0.85, 0.2, 0.15)),
)  # fmt: skip


@lru_cache(maxsize=256)
def subject(number: int) -> Subject:
    """The person that a number stands for.

    Raises:
        InputError: a number below 0 or beyond 2^31 - 1.
    """
    if not 0 <= number <= MOST:
        raise InputError(f"subject {number}, expected 0 to 2^31 - 1")
    if number == 0:
        return FIRST
    palette = _one_of(PALETTES, number, "palette")
    return Subject(
        number=number,
        shape=_shape(number),
        head=_head(number),
        shirt=_shirt(number, palette),
        trousers=_trousers(number, palette),
        skirt=_skirt(number, palette),
        shoes=_shoes(number, palette),
    )


def _shape(number: int) -> Shape:
    gender = _trait(number, "gender")
    return Shape(
        gender=round(0.24 * gender if gender < 0.5 else 0.76 + 0.24 * gender, 3),
        age=_between(number, "age", 0.64, 0.84),
        muscle=_between(number, "muscle", 0.4, 0.7),
        weight=_between(number, "weight", 0.34, 0.62),
        height=_between(number, "height", 0.3, 0.48),
        proportions=_between(number, "proportions", 0.5, 0.85),
        descent=_descent(number),
    )


def _descent(number: int) -> Colour:
    """A mixture that suits the tone of the skin."""
    tone, free = _trait(number, "skin"), _trait(number, "mixture")
    dark = min(max(1.6 * tone - 0.5, 0.0), 1.0)
    return round(dark, 3), round((1 - dark) * free, 3), round((1 - dark) * (1 - free), 3)


def _head(number: int) -> Complexion:
    tone, age = _trait(number, "skin"), _between(number, "age", 0.64, 0.84)
    skin = _along(SKINS, tone)
    # The darker the skin, the fewer of the fair colours of hair and eyes.
    lightest = 1 - min(1.0, 1.5 * tone)
    hair = _along(HAIRS, _trait(number, "hair") * (0.25 + 0.75 * lightest))
    hair = _mixed(hair, GREY, _trait(number, "grey") * min(max((age - 0.73) / 0.08, 0.0), 0.85))
    rosy = _mixed(skin, (0.62, 0.2, 0.2), 0.42)
    return Complexion(
        skin=skin,
        blush=_mixed(skin, (0.85, 0.3, 0.26), 0.35),
        lips=rosy,
        mouth=_scaled(rosy, 0.55),
        brow=_scaled(_mixed(hair, skin, 0.1), 0.85),
        iris=_along(IRISES, _trait(number, "iris") * lightest),
        hair=hair,
        depth=_between(number, "depth", 0.009, 0.02),
        nape=_between(number, "nape", 0.84, 1.15),
    )


def _shirt(number: int, palette: Palette) -> Shirt:
    grounds = (palette.light, palette.soft, palette.middle, palette.deep)
    words = _one_of((*WORDS, None, None, None, None), number, "words")
    return Shirt(
        cloth=_print(number, "top", TOPS, grounds, palette),
        words=words,
        panel=palette.accent,
        ink=palette.dark if _luma(palette.accent) > 0.4 else palette.light,
        collar=palette.accent if words is None else palette.dark,
        seam=palette.dark,
        sleeve=_one_of((1.0, 0.4, 0.8), number, "sleeve"),
    )


def _trousers(number: int, palette: Palette) -> Trousers:
    denim, stone = (0.24, 0.3, 0.4), (0.49, 0.49, 0.43)
    cloth = _print(number, "bottom", BOTTOMS, (palette.dark, palette.deep, denim, stone), palette, strength=0.6)
    return Trousers(
        cloth=cloth,
        line=_mixed(cloth.colours[0], palette.accent, 0.5),
        belt=(0.27, 0.17, 0.11),
        buckle=(0.78, 0.74, 0.62),
        cuff=_one_of((0.17, 0.15, 0.27, 0.5), number, "cuff"),
    )


def _skirt(number: int, palette: Palette) -> Skirt:
    kind = _one_of(GARMENTS, number, "garment")
    length, fullness = _between(number, "length", 0.36, 0.68), _between(number, "fullness", 0.75, 1.5)
    # A long skirt that is narrow would bind the knees.
    full = round(max(fullness, 1.6 * (length - 0.49) + 0.9), 3)
    grounds = (palette.deep, palette.middle, palette.accent, palette.soft)
    if kind == "coat":
        cloth = _print(number, "skirt", COATS, (palette.deep, palette.dark, palette.middle), palette, strength=0.5)
        ground = cloth.colours[0]
        trim = _mixed(ground, palette.light if _luma(ground) < 0.3 else palette.dark, 0.45)
        # Open in front, it binds no knees.
        return Skirt(
            cloth=cloth, hem=trim, length=round(0.48 + 0.5 * (length - 0.36), 3), fullness=round(0.8 * fullness, 3),
            kind=kind,
        )  # fmt: skip
    cloth = _print(number, "skirt", SKIRTS, grounds, palette)
    if kind == "smock":
        length = round(0.14 + 0.3 * (length - 0.36), 3)
        return Skirt(cloth=cloth, hem=palette.light, length=length, fullness=round(0.8 * fullness, 3), kind=kind)
    return Skirt(cloth=cloth, hem=palette.light, length=length, fullness=full, kind=kind)


def _shoes(number: int, palette: Palette) -> Shoes:
    leather = _one_of(((0.2, 0.2, 0.22), (0.36, 0.24, 0.16), palette.dark, (0.8, 0.79, 0.76)), number, "shoes")
    return Shoes(leather=leather, sole=(0.86, 0.84, 0.8), laces=palette.light, stripes=palette.accent)


def _print(
    number: int, name: str, kinds: tuple[str, ...], grounds: tuple[Colour, ...], palette: Palette, strength: float = 1.0
) -> Print:
    """A print whose contrast and scale are the subject's; figures are lighter than dark grounds and the reverse."""
    ground = _one_of(grounds, number, f"{name} ground")
    far = palette.light if _luma(ground) < 0.45 else palette.dark
    contrast = strength * (0.12 + 0.88 * _trait(number, f"{name} contrast"))
    period = FINEST * (COARSEST / FINEST) ** _trait(number, f"{name} period")
    line = _mixed(ground, palette.accent if ground != palette.accent else palette.light, contrast)
    return Print(
        kind=_one_of(kinds, number, name),
        period=round(period, 4),
        colours=(ground, _mixed(ground, far, contrast), line),
    )


def _trait(number: int, name: str) -> float:
    """A trait of a subject, 0..1: a draw from a sixteenth of its own among the subjects of its block."""
    block, place = divmod(number, BLOCK)
    order = sorted(range(BLOCK), key=lambda stratum: hash_of(["cast", name, block, stratum]))
    return (order[place] + int(hash_of(["cast", name, number])[:8], 16) / 2**32) / BLOCK


def _between(number: int, name: str, low: float, high: float) -> float:
    return round(low + (high - low) * _trait(number, name), 4)


def _one_of(choices: tuple[Choice, ...], number: int, name: str) -> Choice:
    return choices[int(_trait(number, name) * len(choices))]


def _along(colours: tuple[Colour, ...], share: float) -> Colour:
    place = share * (len(colours) - 1)
    low = min(int(place), len(colours) - 2)
    return _mixed(colours[low], colours[low + 1], place - low)


def _mixed(a: Colour, b: Colour, share: float) -> Colour:
    mixed = [round(x + share * (y - x), 4) for x, y in zip(a, b, strict=True)]
    return mixed[0], mixed[1], mixed[2]


def _scaled(colour: Colour, factor: float) -> Colour:
    return _mixed((0.0, 0.0, 0.0), colour, factor)


def _luma(colour: Colour) -> float:
    return 0.3 * colour[0] + 0.59 * colour[1] + 0.11 * colour[2]
