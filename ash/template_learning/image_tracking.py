"""The template from nothing but the training videos: the paper's claim, and supervision "images".

A textured mesh is drawn and compared with the images, outlines included: what it shows and where it ends both pull at
the vertices (weak supervision of Habermann et al. 2021, in one stage). Learned together: a texture, 27 numbers of
light, one smooth displacement that all frames share, and per frame a translation of every node of the embedded graph.
What comes out are tracked frames, as from any other supervision.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Camera, Capture, Pose
from ash.gaussians.initialising import initial_texture
from ash.mesh.drawing import draw_mesh, textured, topology_of
from ash.template.graph import EmbeddedGraph
from ash.template.refining import Refinement
from ash.template.template import PosedTemplate, Template
from ash.template_learning.tracking import Tracked
from ash.textures import build_lattice
from ash.training.adam import Adam
from ash.training.batches import Batch, cut_batch, load_training_images

STEPS = 500
SHARED_STEPS = 200  # First only what all frames share.
VIEWS = 1
TEXTURE = 256
RATE = 2e-2  # Of texture and light.
MOVE_RATE = 0.1  # Of displacements, millimetres.
NODE_UNIT_M = 0.001
STIFFNESS = 2e-3  # Against neighbouring nodes that move apart, and
HOLD = 2e-4  # against nodes that move at all; per squared millimetre.


class _Subject(nn.Module):
    """Everything that is learned."""

    def __init__(self, capture: Capture, template: Template, graph: EmbeddedGraph) -> None:
        super().__init__()
        mesh = template.mesh
        self.texture = nn.Parameter(initial_texture(capture, template, build_lattice(mesh, TEXTURE)))
        self.light = nn.Parameter(torch.zeros(9, 3))
        self.shared = Refinement(mesh)
        self.own = nn.Parameter(torch.zeros(len(capture.splits["train"].frames), len(graph.nodes), 3))
        self.graph, self.topology = graph, topology_of(template.faces)
        self.uvs, self.uv_faces = torch.from_numpy(mesh.uvs).float(), torch.from_numpy(mesh.uv_faces)

    def canonical(self, rest: Float[Tensor, "v 3"], index: int) -> Float[Tensor, "v 3"]:
        """The vertices of the `index`-th training frame."""
        return rest + self.shared() + self.graph.spread(NODE_UNIT_M * self.own[index])

    def draw(self, posed: PosedTemplate, canonical: Tensor, camera: Camera, background: Tensor) -> Tensor:
        """Colours over the background, and coverage."""
        shade = textured(self.texture, self.uvs, self.uv_faces, posed.normals, self.topology.faces, self.light)
        vertices = posed.transforms.apply(canonical)
        return draw_mesh(vertices, self.topology, camera, shade, background, outlines=True)

    def restraint(self, index: int) -> Tensor:
        """What keeps a frame's nodes together and at home, where no pixel speaks."""
        nodes = self.own[index]
        apart = nodes - self.graph.adjacency(nodes)
        return STIFFNESS * (apart**2).sum(1).mean() + HOLD * (nodes**2).sum(1).mean()


def track_images(capture: Capture, template: Template, graph: EmbeddedGraph, *, seed: int) -> Tracked:
    """Fit the subject to the training images, and read off where its vertices were."""
    frames = capture.splits["train"].frames
    images = load_training_images(capture)
    rest = torch.from_numpy(template.mesh.vertices).float()
    posed = {frame: template.pose(Pose(capture.motion, frame)) for frame in frames}
    subject = _Subject(capture, template, graph)
    groups = {RATE: [subject.texture, subject.light], MOVE_RATE: list(subject.shared.parameters())}
    shared = [{"params": parameters, "lr": rate} for rate, parameters in groups.items()]
    own = [{"params": [subject.own], "lr": MOVE_RATE}]
    optimiser = Adam(shared + own)
    generator = torch.Generator().manual_seed(seed)
    names = list(images.cameras)
    for step in range(STEPS):
        index = int(torch.randint(len(frames), (), generator=generator))
        chosen = torch.randperm(len(names), generator=generator)[:VIEWS].tolist()
        background = torch.rand(3, generator=generator)
        batch = cut_batch(images, frames[index], [names[i] for i in chosen], background)
        for group, rate in zip(optimiser.groups, (RATE, MOVE_RATE, MOVE_RATE), strict=True):
            group["lr"] = rate * (1 - step / STEPS)
        if step < SHARED_STEPS:
            optimiser.groups[-1]["lr"] = 0.0
        canonical = subject.canonical(rest, index)
        loss = _image_loss(subject, posed[frames[index]], canonical, batch) + subject.restraint(index)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    with torch.no_grad():
        canonical = torch.stack([subject.canonical(rest, index) for index in range(len(frames))])
    return Tracked(frames=frames, canonical=canonical)


def _image_loss(subject: _Subject, posed: PosedTemplate, canonical: Tensor, batch: Batch) -> Tensor:
    """L1 of colours, over a background that is new in every step, and of silhouettes."""
    losses = []
    for camera, target, mask in zip(batch.cameras, batch.targets, batch.foreground, strict=True):
        drawn = subject.draw(posed, canonical, camera, batch.background)
        losses.append((drawn[..., :3] - target).abs().mean() + (drawn[..., 3] - mask).abs().mean())
    return torch.stack(losses).mean()
