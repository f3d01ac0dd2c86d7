"""The CUDA side without a GPU: nvcc takes it for every architecture, and no kernel spills registers to memory."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parents[2] / "csrc"
KERNELS = {
    "stamp_kernel", "forward_kernel", "from_units_kernel", "gather_kernel", "reverse_kernel", "motion_kernel",
    "voxelize_kernel", "gather_voxels_kernel", "reverse_voxels_kernel",
}  # fmt: skip

pytestmark = pytest.mark.system


def nvcc() -> str:
    found = shutil.which("nvcc")
    if not found:
        pytest.skip("no nvcc on this machine")
    return found


@pytest.mark.parametrize("architecture", ["75", "80", "90", "120"])
def test_no_kernel_spills(architecture: str, tmp_path: Path) -> None:
    compiler = nvcc()
    known = subprocess.run([compiler, "--list-gpu-arch"], capture_output=True, text=True, check=True).stdout
    if f"compute_{architecture}" not in known.split():
        pytest.skip(f"this nvcc knows no compute_{architecture}")
    command = [compiler, "-std=c++20", "-O3", f"-I{CSRC}", "-DSPLAT_NS=cuda", "-Xptxas", "-v", "-c"]
    command += ["-gencode", f"arch=compute_{architecture},code=sm_{architecture}"]
    command += [str(CSRC / "cuda/renderer.cu"), "-o", str(tmp_path / "renderer.o")]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    log = built.stdout + built.stderr
    assert built.returncode == 0, log
    assert "warning" not in log, log
    entries = re.findall(
        r"Compiling entry function '(\w+)'.*?(\d+) bytes spill stores, (\d+) bytes spill loads.*?Used (\d+) registers",
        log,
        re.DOTALL,
    )
    seen = set()
    for mangled, stores, loads, registers in entries:
        name = max((k for k in KERNELS if re.search(rf"\d{k}", mangled)), key=len)
        kind = "double" if re.search(rf"{name}Id", mangled) else "float"
        print(f"sm_{architecture} {name}<{kind}>: {registers} registers")
        seen.add((name, kind))
        assert (stores, loads) == ("0", "0"), f"{name}<{kind}> spills"
        assert int(registers) <= 168, f"{name}<{kind}>: fewer than three blocks of 128 threads fit"
    assert {name for name, _ in seen} == KERNELS
    assert len(seen) == 2 * len(KERNELS) - 1  # all but the motion's sum in float and double


@pytest.mark.slow
@pytest.mark.parametrize("wanted", ["AUTO", "OFF", "ON"])
def test_cmake_without_nvcc(wanted: str, tmp_path: Path) -> None:
    """AUTO and OFF configure, ON says what is missing."""
    cmake, ninja = shutil.which("cmake"), shutil.which("ninja")
    if not cmake or not ninja:
        pytest.skip("no cmake or ninja on this machine")
    project = f"cmake_minimum_required(VERSION 3.24)\nproject(t LANGUAGES CXX)\nadd_subdirectory({CSRC}/cuda cuda)\n"
    (tmp_path / "CMakeLists.txt").write_text(project)
    command = [cmake, "-G", "Ninja", f"-DSPLAT_CUDA={wanted}", "-DCMAKE_CUDA_COMPILER=NOTFOUND", "-B", "build", "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == (wanted != "ON"), done.stdout + done.stderr
    if wanted == "ON":
        assert "there is no nvcc" in done.stderr
