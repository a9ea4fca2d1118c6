"""Draw one frame of a trained avatar: .venv/bin/python docs/draw_a_frame.py CELL OUT.png [MOTION.bvh]

CELL is a cell's folder, such as runs/ci/cells/0123456789abcdef. Without a motion file its own test motion is drawn.
"""

import sys
from pathlib import Path

from ash.files import write_image
from benchmarks.play.avatars import load_avatar

avatar = load_avatar(sys.argv[1])
motion = avatar.read_motion(sys.argv[3]) if len(sys.argv) > 3 else avatar.motion
image = avatar.draw(motion, frame=len(motion.dofs) - 1, camera=next(iter(avatar.cameras.values())))
write_image(Path(sys.argv[2]), image)
