"""Motion as the networks see it: relative to where the frame that they predict stands."""

import torch
from jaxtyping import Float
from torch import Tensor

from ash.capture.dataset import Pose
from ash.rotations import quat_multiply, root_yaw, rotate, rotvec_to_unitquat, unitquat_to_rotvec


@torch.no_grad()
def normalised_motion(pose: Pose, *, window: int, yaw_normalise: bool) -> Float[Tensor, "k d"]:
    """Degrees of freedom of a window of frames, newest first; root translations relative to the newest (ASH Sec. 3.1).

    With `yaw_normalise` translations become R_y(-yaw) (t_k - t_f), and root rotations are turned by -yaw, as in the
    release: the result does not say where the newest frame faces.
    """
    dofs = torch.from_numpy(pose.motion.dofs[pose.window(window)])
    if not yaw_normalise:
        return torch.cat([dofs[:, :3] - dofs[0, :3], dofs[:, 3:]], dim=1).float()
    yaw = root_yaw(dofs[0])
    unturn = about_y(-yaw).expand(len(dofs), 4)
    translation = rotate(unturn, dofs[:, :3] - dofs[0, :3])
    root = quat_multiply(unturn, rotvec_to_unitquat(dofs[:, 3:6]))
    return torch.cat([translation, unitquat_to_rotvec(root), dofs[:, 6:]], dim=1).float()


def about_y(angle: Float[Tensor, ""]) -> Float[Tensor, " 4"]:
    """The rotation about the vertical by an angle in radians, wxyz."""
    zero = torch.zeros_like(angle)
    return rotvec_to_unitquat(torch.stack([zero, angle, zero]))
