"""Stg.3: from motion-aware textures to the canonical texel Gaussians' raw parameters (ASH Eq. 6 and 7)."""

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

import ash.native.library
import ash.native.unet
from ash.config import ModelConfig
from ash.gaussians.gaussians import GEOMETRY_CHANNELS, raw_channels
from ash.textures import DecoderInputs, FrameInputs, TexelLattice

GLOBAL_FEATURES = 16
OCTAVES = 6
TILED_CHANNELS = 16  # of which the native bfloat16 kernels take whole multiples
NATIVE_CHANNELS = 1024  # at the bottleneck, at most: the width of preset `paper`


class ConvBlock(nn.Sequential):
    """Two 3x3 convolutions with norm and ReLU (Ronneberger et al. 2015, with padding)."""

    def __init__(self, inputs: int, outputs: int, norm: str) -> None:
        layers: list[nn.Module] = []
        for channels in (inputs, outputs):
            layers.append(nn.Conv2d(channels, outputs, 3, padding=1, bias=norm == "none"))
            if norm == "instance":
                layers.append(nn.InstanceNorm2d(outputs, affine=True))
            elif norm == "batch-as-released":
                layers.append(nn.BatchNorm2d(outputs, track_running_stats=False))
            layers.append(nn.ReLU(inplace=True))
        super().__init__(*layers)


class UNet(nn.Module):
    """The image-to-image network of ASH: `levels` halvings, skips by concatenation, a 1x1 head.

    The head starts at zero, so that an untrained decoder returns the initial Gaussians exactly.
    """

    def __init__(
        self, inputs: int, outputs: int, *, width: int, levels: int, norm: str, bottleneck_features: int = 0
    ) -> None:
        super().__init__()
        self.plain = norm == "none"  # convolutions and ReLU alone, as the native kernels have them
        self.bottleneck_features = bottleneck_features
        widths = [width * 2**level for level in range(levels + 1)]
        self.first = ConvBlock(inputs, width, norm)
        self.down = nn.ModuleList(ConvBlock(a, b, norm) for a, b in pairwise(widths))
        up_inputs = [widths[-1] + bottleneck_features, *widths[-2:0:-1]]
        pairs = list(zip(up_inputs, widths[-2::-1], strict=True))
        self.up = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in pairs)
        self.merge = nn.ModuleList(ConvBlock(2 * b, b, norm) for _, b in pairs)
        self.head = nn.Conv2d(width, outputs, 1)
        if norm == "none":
            self.apply(_keep_variance)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(
        self, texture: Float[Tensor, "b c h w"], features: Float[Tensor, "*each p"] | None = None
    ) -> Float[Tensor, "b o h w"]:
        """Map textures to textures; `features`, of all or of each, are broadcast over the bottleneck.

        `forward_naive` is the definition; float32 images on the CPU go one by one through native kernels. Under torch's
        autocast these round the factors of their 3x3 convolutions to bfloat16, where the machine has tiles for it.
        """
        if not self._can_use_native(texture):
            return self.forward_naive(texture, features)
        return self._native(texture, features, None)

    def picked(
        self, texture: Float[Tensor, "b c h w"], features: Float[Tensor, "*each p"] | None, rows: "TexelRows"
    ) -> Float[Tensor, "b n o"]:
        """Of `forward`'s result the texels' rows: nothing is shuffled or kept that will not be used."""
        width = self.head.out_channels // rows.of_pixel
        if self._can_use_native(texture):
            return self._native(texture, features, ash.native.unet.Picks(rows.places, rows.lines, width))
        # In the network's own memory order a pixel's channels are its texels', one after the other.
        pixels = self.forward_naive(texture, features).permute(0, 2, 3, 1)
        return pixels.reshape(len(texture), -1, width).index_select(1, rows.rows)

    def _native(
        self,
        texture: Float[Tensor, "b c h w"],
        features: Float[Tensor, "*each p"] | None,
        picks: ash.native.unet.Picks | None,
    ) -> Tensor:
        height, width = texture.shape[2:]
        shape = ash.native.unet.UNetShape(
            height,
            width,
            texture.shape[1],
            self.head.out_channels,
            self.head.in_channels,
            len(self.down),
            self.bottleneck_features,
            torch.is_autocast_enabled("cpu"),
        )
        features = None if features is None else features.float()
        each = [features] * len(texture) if features is None or features.dim() == 1 else features.unbind()
        run, layers, threads = ash.native.unet.unet, self._layers(), torch.get_num_threads()
        return as_batch([run(shape, *one, layers, threads, picks) for one in zip(texture, each, strict=True)])

    def _can_use_native(self, texture: Tensor) -> bool:
        """Whether the kernels have this architecture, size and precision; the texture gets no gradient from them."""
        levels = len(self.down)
        divisible = levels > 0 and not any(size % 2**levels for size in texture.shape[2:])
        narrow = self.head.in_channels * 2**levels <= NATIVE_CHANNELS
        float32_on_cpu = texture.dtype == self.head.weight.dtype == torch.float32 and texture.device.type == "cpu"
        precise = not torch.is_autocast_enabled("cpu") or self._can_use_tiles()
        return self.plain and divisible and narrow and float32_on_cpu and not texture.requires_grad and precise

    def _can_use_tiles(self) -> bool:
        return self.head.in_channels % TILED_CHANNELS == 0 and ash.native.library.has_tiles()

    def _layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of every layer: the blocks down, then each way up and its block, then the head."""
        layers: list[nn.Module] = [*self.first.children()]
        for block in self.down:
            layers += block.children()
        for up, merge in zip(self.up, self.merge, strict=True):
            layers += [up, *merge.children()]
        return [(layer.weight, layer.bias) for layer in (*layers, self.head) if not isinstance(layer, nn.ReLU)]

    def forward_naive(
        self, texture: Float[Tensor, "b c h w"], features: Float[Tensor, "*each p"] | None = None
    ) -> Float[Tensor, "b o h w"]:
        """The network as it is defined, layer by layer."""
        skips = [self.first(texture)]
        for block in self.down:
            skips.append(block(nn.functional.max_pool2d(skips[-1], 2)))
        x = skips.pop()
        if features is not None:
            x = torch.cat([x, features[..., None, None].expand(len(x), -1, *x.shape[2:])], 1)
        for up, merge in zip(self.up, self.merge, strict=True):
            x = merge(torch.cat([up(x), skips.pop()], 1))
        return self.head(x)


def _keep_variance(layer: nn.Module) -> None:
    """He et al. 2015. Without a norm, torch's own start shrinks features layer by layer; nothing is left at the head.

    A transposed convolution of stride 2 and size 2 has one tap per output pixel, so its fan is its input channels.
    """
    if isinstance(layer, nn.Conv2d):
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    elif isinstance(layer, nn.ConvTranspose2d):
        nn.init.normal_(layer.weight, std=layer.in_channels**-0.5)
    if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d) and layer.bias is not None:
        nn.init.zeros_(layer.bias)


def decoding_precision(wanted: str, device: torch.device, width: int) -> str:
    """The precision in which U-Nets of a width decode: bfloat16 if it is wanted, and pays here.

    On the CPU it pays where the processor has tiles for it (AMX); elsewhere it would be slower than float32.
    """
    pays = device.type != "cpu" or (width % TILED_CHANNELS == 0 and ash.native.library.has_tiles())
    return wanted if pays else "float32"


def decoding_in(precision: str, device: torch.device) -> AbstractContextManager[object]:
    """The context in which U-Nets decode in a precision of `decoding_precision`."""
    return torch.autocast(device.type, torch.bfloat16) if precision == "bfloat16" else nullcontext()


class GlobalFeatures(nn.Module):
    """Phi: the root translation, positionally encoded, through a 3-layer MLP of width 32 (ASH appendix A).

    The release's first layer is 64 wide, and its translation is divided by 1.2.
    """

    def __init__(self, layers: str) -> None:
        super().__init__()
        wide, self.scale = {"paper": (32, 1.0), "released": (64, 1.2)}[layers]
        self.mlp = nn.Sequential(
            nn.Linear(3 + 6 * OCTAVES, wide), nn.ReLU(), nn.Linear(wide, 32), nn.ReLU(), nn.Linear(32, GLOBAL_FEATURES)
        )

    def forward(self, translation: Float[Tensor, "*each 3"]) -> Float[Tensor, "*each 16"]:
        """Features of root translations in metres."""
        translation = translation / self.scale
        angles = translation[..., None] * 2.0 ** torch.arange(OCTAVES, device=translation.device)
        return self.mlp(torch.cat([translation, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1))


def as_batch(tensors: Sequence[Tensor]) -> Tensor:
    """Tensors one above the other; a single one is not copied."""
    return tensors[0][None] if len(tensors) == 1 else torch.stack(list(tensors))


def apart(batch: Tensor) -> Sequence[Tensor]:
    """The tensors of a batch; the gradient of a single one is not copied either."""
    return [batch.squeeze(0)] if len(batch) == 1 else batch.unbind()


def batched_inputs(
    frames: Sequence[DecoderInputs], phi: GlobalFeatures | None
) -> tuple[Float[Tensor, "b c r r"], Float[Tensor, "*each 16"] | None]:
    """Frames as one batch for U-Nets: textures in their memory order, and Phi."""
    textures = as_batch([frame.textures for frame in frames]).contiguous(memory_format=torch.channels_last)
    where = as_batch([frame.root_translation for frame in frames])
    return textures, None if phi is None else phi(where.squeeze(0))


class Decoders(nn.Module):
    """E_geo and E_app: motion-aware textures and Phi to the raw parameters of every texel's Gaussian."""

    def __init__(self, config: ModelConfig, lattice: TexelLattice) -> None:
        super().__init__()
        self.texels = TexelRows(lattice, config.shuffle)
        features = GLOBAL_FEATURES if config.global_features else 0
        outputs = [GEOMETRY_CHANNELS, raw_channels(config) - GEOMETRY_CHANNELS]
        if config.shared_trunk:
            outputs = [sum(outputs)]
        phi_inputs = [0] * (len(outputs) - 1) + [features]
        self.nets = nn.ModuleList(
            UNet(
                6 * config.window,
                count * config.shuffle**2,
                width=config.width,
                levels=config.levels,
                norm=config.norm,
                bottleneck_features=phi,
            )
            for count, phi in zip(outputs, phi_inputs, strict=True)
        )
        self.phi = GlobalFeatures(config.global_mlp) if config.global_features else None
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, inputs: Sequence[FrameInputs]) -> Float[Tensor, "b n o"]:
        """Decode several frames as one batch."""
        x, phi = batched_inputs(inputs, self.phi)
        features = [None] * (len(self.nets) - 1) + [phi]  # E_geo does not get Phi, unless the trunk is shared.
        nets = cast(Iterable[UNet], self.nets)
        decoded = [net.picked(x, extra, self.texels) for net, extra in zip(nets, features, strict=True)]
        return decoded[0] if len(decoded) == 1 else torch.cat(decoded, -1)


class TexelRows(nn.Module):
    """Where the texels of the lattice lie in a texture decoded at 1/shuffle of its resolution.

    A decoded pixel's channels are its `shuffle x shuffle` texels, equally many each: rows of a table.
    """

    def __init__(self, lattice: TexelLattice, shuffle: int) -> None:
        super().__init__()
        self.of_pixel = shuffle**2
        side = lattice.resolution // shuffle
        row, column = lattice.texels // lattice.resolution, lattice.texels % lattice.resolution
        within = column // shuffle * shuffle**2 + row % shuffle * shuffle + column % shuffle
        self.rows: Int[Tensor, " n"]
        self.places: Int[Tensor, " n"]  # the same within its line of decoded pixels
        self.lines: Int[Tensor, " l"]  # which texels belong to each of those: the lattice lists them from top to bottom
        self.register_buffer("rows", row // shuffle * side * shuffle**2 + within, persistent=False)
        self.register_buffer("places", within.int(), persistent=False)
        self.register_buffer("lines", torch.searchsorted(row // shuffle, torch.arange(side + 1)), persistent=False)
