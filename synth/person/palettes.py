"""Colours: those of clothes that go together, and those of skin, hair and eyes."""

from dataclasses import dataclass

Colour = tuple[float, float, float]  # sRGB, 0..1


@dataclass(frozen=True, kw_only=True, slots=True)
class Palette:
    """Colours that go together."""

    light: Colour
    soft: Colour
    middle: Colour
    deep: Colour
    dark: Colour
    accent: Colour


PALETTES = (
    Palette(  # harbour
        light=(0.87, 0.87, 0.83), soft=(0.66, 0.73, 0.77), middle=(0.4, 0.53, 0.63), deep=(0.22, 0.33, 0.45),
        dark=(0.13, 0.18, 0.26), accent=(0.8, 0.43, 0.24),
    ),
    Palette(  # woodland
        light=(0.87, 0.84, 0.74), soft=(0.68, 0.71, 0.57), middle=(0.45, 0.53, 0.37), deep=(0.26, 0.36, 0.27),
        dark=(0.19, 0.18, 0.15), accent=(0.78, 0.55, 0.22),
    ),
    Palette(  # heather
        light=(0.89, 0.84, 0.85), soft=(0.74, 0.63, 0.7), middle=(0.56, 0.39, 0.5), deep=(0.36, 0.21, 0.31),
        dark=(0.2, 0.17, 0.22), accent=(0.42, 0.56, 0.52),
    ),
    Palette(  # clay
        light=(0.91, 0.85, 0.76), soft=(0.83, 0.68, 0.54), middle=(0.7, 0.45, 0.33), deep=(0.45, 0.26, 0.2),
        dark=(0.22, 0.19, 0.19), accent=(0.29, 0.46, 0.5),
    ),
    Palette(  # slate
        light=(0.85, 0.86, 0.87), soft=(0.67, 0.69, 0.71), middle=(0.46, 0.49, 0.53), deep=(0.29, 0.31, 0.36),
        dark=(0.15, 0.16, 0.19), accent=(0.73, 0.25, 0.24),
    ),
    Palette(  # lagoon
        light=(0.85, 0.9, 0.88), soft=(0.6, 0.76, 0.74), middle=(0.29, 0.55, 0.56), deep=(0.12, 0.35, 0.4),
        dark=(0.13, 0.2, 0.25), accent=(0.9, 0.6, 0.38),
    ),
    Palette(  # dusk
        light=(0.87, 0.85, 0.9), soft=(0.68, 0.66, 0.78), middle=(0.45, 0.43, 0.62), deep=(0.28, 0.26, 0.43),
        dark=(0.17, 0.17, 0.25), accent=(0.86, 0.66, 0.36),
    ),
    Palette(  # harvest
        light=(0.92, 0.88, 0.76), soft=(0.86, 0.74, 0.5), middle=(0.75, 0.54, 0.25), deep=(0.48, 0.3, 0.16),
        dark=(0.2, 0.22, 0.28), accent=(0.5, 0.2, 0.2),
    ),
)  # fmt: skip
SKINS: tuple[Colour, ...] = (
    (0.91, 0.75, 0.65), (0.86, 0.68, 0.56), (0.8, 0.6, 0.46), (0.71, 0.51, 0.38), (0.58, 0.4, 0.29),
    (0.46, 0.31, 0.22), (0.36, 0.24, 0.175),
)  # fmt: skip
HAIRS: tuple[Colour, ...] = (
    (0.09, 0.07, 0.065), (0.16, 0.1, 0.07), (0.27, 0.17, 0.1), (0.4, 0.25, 0.14), (0.6, 0.44, 0.26), (0.47, 0.22, 0.11),
)  # fmt: skip
GREY: Colour = (0.6, 0.59, 0.57)
IRISES: tuple[Colour, ...] = ((0.2, 0.13, 0.08), (0.3, 0.21, 0.12), (0.25, 0.36, 0.3), (0.28, 0.4, 0.5))
