"""No function compiled for AVX may bear a name that the linker could merge with another's.

A weak function such as std::max<float>, compiled once with and once without AVX-512, is one symbol to the linker;
whichever it keeps serves all, and an older processor meets an illegal instruction. Everything must stay in the
namespace of its instruction set.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parents[2] / "csrc"
CMAKE = (CSRC / "CMakeLists.txt").read_text()
ISAS = dict(re.findall(r"add_isa\((\w+)\s*([^)]*)\)", CMAKE.partition("nanobind_add_module")[2]))


def flags() -> list[str]:
    found = re.search(r"set\(SPLAT_FLAGS ([^)]*)\)", CMAKE)
    assert found
    return found.group(1).split()


def test_the_build_is_read() -> None:
    assert set(ISAS) == {"plain", "avx2", "avx512"}
    assert "-O3" in flags()


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("isa", ISAS)
def test_functions_stay_in_their_namespace(isa: str, tmp_path: Path) -> None:
    compiler, nm = shutil.which("c++"), shutil.which("nm")
    if not compiler or not nm:
        pytest.skip("no C++ compiler or nm on this machine")
    made = tmp_path / "isa.o"
    command = [compiler, "-std=c++20", "-fPIC", "-fvisibility=hidden", "-fopenmp", "-DNDEBUG", *flags()]
    command += [*ISAS[isa].split(), f"-DSPLAT_NS={isa}", f"-I{CSRC}", "-c", str(CSRC / "cpu/isa.cpp"), "-o", str(made)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if "unrecognized" in built.stderr and ISAS[isa]:
        pytest.skip(f"the compiler knows no {ISAS[isa]}")
    assert built.returncode == 0, built.stderr
    assert not built.stderr, built.stderr  # warnings
    listing = subprocess.run([nm, "-C", "--defined-only", str(made)], capture_output=True, text=True, check=True)
    # T and W are functions that other objects can see; data (V, u, R: type names, constants) holds no instructions.
    functions = re.findall(r"^[0-9a-f]+ [TW] (.*)$", listing.stdout, re.MULTILINE)
    assert len(functions) > 10
    assert [name for name in functions if f"splat::{isa}::" not in name] == []
