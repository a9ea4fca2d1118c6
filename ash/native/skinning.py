"""The native kernels of Stg. 1: dual quaternion skinning and vertex normals. No gradients.

They save 2.4 ms of a played frame of the default `ash` (16 ms, 7,000 vertices, one thread), and 0.2 % of its training,
where a frame is posed once.
"""

import torch
from torch import Tensor

from ash.native.library import address, load


def can_use_native(*tensors: Tensor) -> bool:
    """Whether the kernels may be used: float32 on the CPU, no gradient needed."""
    return all(
        t.dtype == torch.float32 and t.device.type == "cpu" and not (t.requires_grad and torch.is_grad_enabled())
        for t in tensors
    )


def skin_vertices(joints: Tensor, skin: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions `[v, 4]` and translations `[v, 3]` from joints' dual quaternions `[j, 8]`, int64 `skin` `[v, k]`."""
    inputs = joints.contiguous(), skin.contiguous(), weights.contiguous()
    count, influences = skin.shape
    skinned = torch.empty(count, 4, device="cpu"), torch.empty(count, 3, device="cpu")
    load().ash_skin_vertices(*map(address, inputs), count, influences, torch.get_num_threads(), *map(address, skinned))
    return skinned


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals `[v, 3]`; int64 `faces` `[f, 3]`."""
    inputs = vertices.contiguous(), faces.contiguous()
    normals = torch.empty(len(vertices), 3, device="cpu")
    load().ash_vertex_normals(*map(address, inputs), len(vertices), len(faces), address(normals))
    return normals
