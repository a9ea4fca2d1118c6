"""Which template a method stands on. A learned one is made once per capture, configuration and seed, and kept.

So is what it is learned from, the template tracked through the training frames: configurations share it.
"""

import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from ash.capture.dataset import Capture
from ash.capture.formats import read_template_truth
from ash.checkpoints import load_module, read_safetensors
from ash.config import TemplateConfig
from ash.devices import CPU, moved
from ash.files import InputError, file_lock, hash_of, hash_sources, write_atomic
from ash.template.graph import EmbeddedGraph
from ash.template.template import (
    Deformation,
    Learned,
    PlantedError,
    RestDeformation,
    Template,
    exact_template,
    skinned_template,
)
from ash.template_learning.deforming import LinearDeformation
from ash.template_learning.graph_nets import GraphDeformation
from ash.template_learning.image_tracking import track_images
from ash.template_learning.regressing import fit_graph, fit_linear
from ash.template_learning.tracking import Tracked, track_scans

Deformer = LinearDeformation | GraphDeformation


def template_of(config: TemplateConfig, capture: Capture, *, seed: int, device: torch.device = CPU) -> Template:
    """The template that a configuration names, on the CPU; "exact" is for oracles. Learning happens on `device`."""
    if config.kind == "skinned":
        return skinned_template(capture)
    if config.kind == "exact":
        planted = PlantedError(rms_mm=config.error_mm)
        return exact_template(capture, read_template_truth(capture), planted=planted, seed=seed)
    return learned_template(config, capture, seed=seed, device=device)


def learned_template(config: TemplateConfig, capture: Capture, *, seed: int, device: torch.device = CPU) -> Template:
    """Learn the template on a device, or read it from the capture's `store` where an equal one lies; to the CPU.

    A capture without a store has it learned anew each time, to the same result. Of two processes that want the same
    template at once, one learns it and the other waits.
    """
    torch.manual_seed(seed)
    make = LinearDeformation if config.network == "linear" else GraphDeformation
    deformation: Deformer = make(config, capture.template, capture.skeleton)
    template = _around(deformation, deformation.graph, config, capture)
    if capture.store is None:
        facts = _learn(deformation, config, capture, seed, device)
    else:
        path = capture.store / f"{template_key(config, capture, seed=seed, device=device)}.safetensors"
        with file_lock(path):
            if not path.exists():
                facts = _learn(deformation, config, capture, seed, device)
                write_atomic(path, safetensors.torch.save(_state(deformation), metadata=facts))
            tensors, facts = read_safetensors(path)
            load_module(deformation, tensors, path)
            if not facts.keys() >= {"seconds", "summary"}:
                raise InputError(f"{path}: expected a learned template with its facts; remove it")
    template.learned = Learned(seconds=float(facts["seconds"]), summary=facts["summary"])
    return template


def template_key(config: TemplateConfig, capture: Capture, *, seed: int, device: torch.device = CPU) -> str:
    """Hash of everything that decides a learned template, sources included."""
    drawn = seed if config.network == "graph" else 0  # Else nothing is random.
    return _key(config, capture, device, {"config": asdict(config), "seed": drawn})


def _key(config: TemplateConfig, capture: Capture, device: torch.device, decisive: dict[str, Any]) -> str:
    train = capture.splits["train"]
    seen = {
        "capture": capture.identity,
        "train": asdict(train) if config.supervision == "images" else train.frames,
        "device": device.type,
        "sources": hash_sources(Path(__file__).parents[1]),
    }
    return hash_of(decisive | seen)[:16]


def _around(deformation: Deformation, graph: EmbeddedGraph, config: TemplateConfig, capture: Capture) -> Template:
    through = graph if config.released else None
    return Template(capture.template, capture.skeleton, deformation, through=through)


def _learn(
    deformation: Deformer, config: TemplateConfig, capture: Capture, seed: int, device: torch.device
) -> dict[str, str]:
    """Learn in place: on the device, and back. The seconds include those of a tracking that was found in the store."""
    deformation.to(device)
    tracked, seconds = _tracked_once(deformation.graph, config, capture, device)
    start = time.perf_counter()
    if isinstance(deformation, LinearDeformation):
        fit_linear(deformation, capture.motion, tracked)
        choices = "a linear map per node"
    else:
        step = fit_graph(deformation, capture.motion, tracked, steps=config.steps, seed=seed)
        choices = f"step {step} of {config.steps}"
    deformation.to(CPU)
    seconds += time.perf_counter() - start
    return {"seconds": repr(seconds), "summary": f"learned from {config.supervision}: {choices}"}


def _tracked_once(
    graph: EmbeddedGraph, config: TemplateConfig, capture: Capture, device: torch.device
) -> tuple[Tracked, float]:
    """The template in the training frames and the seconds that tracking took, from the store where it lies there."""
    frames = capture.splits["train"].frames
    if capture.store is None:
        return _track(graph, config, capture, device)
    decisive = {"tracked": config.supervision, "nodes": config.nodes, "released": config.released}
    path = capture.store / f"tracked-{_key(config, capture, device, decisive)}.safetensors"
    with file_lock(path):
        if not path.exists():
            tracked, seconds = _track(graph, config, capture, device)
            tensors = {"canonical": tracked.canonical.cpu().contiguous()}
            write_atomic(path, safetensors.torch.save(tensors, metadata={"seconds": repr(seconds)}))
        tensors, facts = read_safetensors(path)
    shape = (len(frames), len(capture.template.vertices), 3)
    if "seconds" not in facts or "canonical" not in tensors or tensors["canonical"].shape != shape:
        raise InputError(f"{path}: expected the template in {len(frames)} training frames; remove it")
    return Tracked(frames=frames, canonical=tensors["canonical"].to(device)), float(facts["seconds"])


def _track(
    graph: EmbeddedGraph, config: TemplateConfig, capture: Capture, device: torch.device
) -> tuple[Tracked, float]:
    start = time.perf_counter()
    at_rest = _around(RestDeformation(capture.template), moved(graph, CPU), config, capture).to(device)
    track = partial(track_images, graph=graph) if config.supervision == "images" else track_scans
    return track(capture, at_rest), time.perf_counter() - start


def _state(deformation: Deformer) -> dict[str, torch.Tensor]:
    return {name: tensor.contiguous() for name, tensor in deformation.state_dict().items()}
