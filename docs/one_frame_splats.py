"""A splatting trainer in plain torch that knows nothing of this project: `python one_frame_splats.py TRAIN TEST OUT`.

TRAIN is one frame's folder of `export --format nerfstudio`, TEST what `export --format test-views` wrote. Gaussians lie
on the posed template, learn their colour, size, opacity and height above it from that one frame, and move with it.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

COUNT, STEPS, REACH = 2000, 60, 2  # Gaussians; steps of Adam; pixels on each side of a Gaussian's own


def read_training(folder):
    """Views of `transforms.json`: RGBA `[h, w, 4]` premultiplied, K, world to camera with OpenCV axes."""
    views = []
    for row in json.loads((folder / "transforms.json").read_text())["frames"]:
        rgba = torch.from_numpy(np.array(Image.open(folder / row["file_path"]))).float() / 255
        image = torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], dim=-1)
        K = [[row["fl_x"], 0, row["cx"]], [0, row["fl_y"], row["cy"]], [0, 0, 1]]
        viewmat = np.linalg.inv(np.array(row["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))
        views.append((image, torch.tensor(K, dtype=torch.float32), torch.from_numpy(viewmat).float()))
    return views


class Splats(torch.nn.Module):
    """Isotropic Gaussians on a mesh."""

    def __init__(self, vertices, faces):
        super().__init__()
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        area = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
        self.triangles = faces[torch.multinomial(area, COUNT, replacement=True)]
        self.weights = torch.distributions.Dirichlet(torch.ones(3)).sample((COUNT,))
        size = 0.7 * float((area.sum() / COUNT).sqrt())
        self.colour = torch.nn.Parameter(torch.zeros(COUNT, 3))
        self.opacity = torch.nn.Parameter(torch.full((COUNT,), 1.0))
        self.log_size = torch.nn.Parameter(torch.full((COUNT,), size).log())
        self.height_mm = torch.nn.Parameter(torch.zeros(COUNT))

    def means(self, vertices):
        """Centres `[n, 3]` on a posed template."""
        a, b, c = (vertices[self.triangles[:, k]] for k in range(3))
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        foot = (torch.stack([a, b, c], dim=1) * self.weights[..., None]).sum(dim=1)
        return foot + 1e-3 * self.height_mm[:, None] * normal

    def render(self, vertices, K, viewmat, width, height):
        """RGBA `[h, w, 4]`, premultiplied: fragments of all Gaussians, sorted by pixel and depth, then blended."""
        seen = self.means(vertices) @ viewmat[:3, :3].T + viewmat[:3, 3]
        depth = seen[:, 2]
        centre = (seen @ K.T)[:, :2] / depth[:, None]
        steps = torch.arange(-REACH, REACH + 1)
        shift = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
        pixel = centre.detach().floor().long()[:, None] + shift  # [n, p, 2], column first
        squared = ((pixel + 0.5 - centre[:, None]) ** 2).sum(dim=-1)
        variance = (self.log_size.exp() * K[0, 0] / depth) ** 2 + 0.1
        alpha = (self.opacity.sigmoid()[:, None] * (-0.5 * squared / variance[:, None]).exp()).clamp(max=0.99)
        inside = (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height) & (alpha > 1 / 255)
        which = torch.arange(COUNT)[:, None].expand_as(alpha)[inside]
        place, alpha = (pixel[..., 1] * width + pixel[..., 0])[inside], alpha[inside]
        order = torch.argsort(depth.detach()[which], stable=True)
        order = order[torch.argsort(place[order], stable=True)]
        which, place, alpha = which[order], place[order], alpha[order]
        passed = torch.cumsum(torch.log1p(-alpha.double()), dim=0)
        before = passed - torch.log1p(-alpha.double())
        first = torch.searchsorted(place, place)  # of each fragment's pixel
        weight = (before - before[first]).exp().float() * alpha
        rgba = torch.cat([self.colour.sigmoid()[which], torch.ones_like(alpha)[:, None]], dim=-1)
        image = torch.zeros(height * width, 4).index_add(0, place, weight[:, None] * rgba)
        return image.reshape(height, width, 4)


def posed_template(folder, frame):
    """Vertices of the template in a frame."""
    return torch.from_numpy(np.load(folder / "posed_template" / f"{frame:06d}.npz")["vertices"])


def main(train, test, out):
    """Train on one frame, then render every view that is asked for."""
    torch.manual_seed(0)
    began = time.perf_counter()
    views = read_training(train)
    faces = torch.from_numpy(np.load(test / "template.npz")["faces"]).long()
    still = posed_template(test, int(train.name.removeprefix("frame_")))
    splats = Splats(still, faces)
    optimiser = torch.optim.Adam(splats.parameters(), lr=0.1)
    for step in range(STEPS):
        image, K, viewmat = views[step % len(views)]
        drawn = splats.render(still, K, viewmat, image.shape[1], image.shape[0])
        loss = (drawn - image).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    trained = time.perf_counter()
    cameras = {row["name"]: row for row in json.loads((test / "cameras.json").read_text())["cameras"]}
    wanted = json.loads((test / "views.json").read_text())["views"]
    for view in wanted:
        camera = cameras[view["camera"]]
        K, viewmat = (torch.tensor(camera[name], dtype=torch.float32) for name in ("K", "viewmat"))
        with torch.no_grad():
            vertices = posed_template(test, view["frame"])
            image = splats.render(vertices, K, viewmat, camera["width"], camera["height"])
        target = out / view["image"]
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray((255 * image.clamp(0, 1)).round().byte().numpy()).save(target)
    info = {
        "alpha": "premultiplied",
        "training_s": trained - began,
        "frame_ms": 1e3 * (time.perf_counter() - trained) / len(wanted),
        "device": "CPU",
        "parameters": sum(parameter.numel() for parameter in splats.parameters()),
    }
    (out / "info.json").write_text(json.dumps(info))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
