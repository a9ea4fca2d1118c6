"""What images add to a template after it was learned: the paper leaves it to the future, DDC lives by it."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import TemplateMesh
from ash.template.graph import vertex_neighbours

UNIT_M = 0.004  # Of what is learned: Adam's step of 0.02 is then a twelfth of a millimetre.
SWEEPS = 4  # Of smoothing over neighbours: a vertex is pulled by the pixels around it, not by a handful of its own.


class Refinement(nn.Module):
    """A displacement of every canonical vertex, the same in all frames, that an avatar learns with the rest of it."""

    def __init__(self, mesh: TemplateMesh) -> None:
        super().__init__()
        self.neighbours = vertex_neighbours(mesh)
        self.rough = nn.Parameter(torch.zeros(len(mesh.vertices), 3))

    def forward(self) -> Float[Tensor, "v 3"]:
        """Metres, canonical."""
        shift: Tensor = self.rough
        for _ in range(SWEEPS):
            shift = 0.5 * (shift + self.neighbours(shift))
        return UNIT_M * shift
