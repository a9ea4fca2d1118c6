"""Motion files as users bring them: a small BVH and an AMASS-style archive."""

from pathlib import Path

import numpy as np

UPRIGHT = [np.pi / 2, 0.0, 0.0]  # AMASS worlds have z up, SMPL's rest pose has y up


def amass_file(path: Path, **changes) -> Path:
    """Five frames at 60 per second: the left knee bends, the left arm sinks."""
    poses = np.zeros((5, 156))
    poses[:, :3] = UPRIGHT
    poses[2:, 4 * 3] = 1.0  # left knee
    poses[3:, 16 * 3 + 2] = -1.2  # left upper arm, lowered
    arrays = {"poses": poses, "trans": np.linspace([0, 0, 0.9], [0, -1.0, 0.9], 5), "mocap_framerate": np.array(60.0)}
    np.savez(path, **{**arrays, **changes})
    return path


BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 90 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT Spine
 {
  OFFSET 0 10 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  JOINT Neck
  {
   OFFSET 0 40 0
   CHANNELS 0
   End Site
   {
    OFFSET 0 10 0
   }
  }
%s%s }
%s%s}
MOTION
Frames: 2
Frame Time: 0.04
"""
ARM = """  JOINT %sArm
  {
   OFFSET %d 40 0
   CHANNELS 0
   JOINT %sForeArm
   {
    OFFSET %d 0 0
    CHANNELS 0
    End Site
    {
     OFFSET %d 0 0
    }
   }
  }
"""
LEG = """ JOINT %sUpLeg
 {
  OFFSET %d 0 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  JOINT %sLeg
  {
   OFFSET 0 -40 0
   CHANNELS 3 Zrotation Xrotation Yrotation
   JOINT %sFoot
   {
    OFFSET 0 -40 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
     OFFSET 0 0 12
    }
   }
  }
 }
"""


def bvh_file(path: Path, *, frames: str | None = None) -> Path:
    """Two frames at 25 per second: upright, then a quarter turn with a bent left knee."""
    sides = (("Left", 1), ("Right", -1))
    arms = [ARM % (side, sign * 15, side, sign * 28, sign * 25) for side, sign in sides]
    text = BVH % (*arms, *(LEG % (side, sign * 10, side, side) for side, sign in sides))
    still = ["0"] * 3 + ["0"] * 3 + ["0"] * 3 + ["0"] * 18
    moved = ["0", "0", "40"] + ["0", "0", "90"] + ["0"] * 3 + ["0"] * 3 + ["0", "60", "0"] + ["0"] * 12
    path.write_text(text + (frames if frames is not None else " ".join(still) + "\n" + " ".join(moved) + "\n"))
    return path
