"""The solver's kernels as an object file: `python export_kernels.py kernels.o`.

What numba compiles for the package is compiled here once more, ahead of time, behind an interface of
plain pointers and numbers, for the processor family of this machine. It is the package's own solver;
what links it needs no Python. `shortfinal.cpp` calls it, and `CMakeLists.txt` builds both. A second
argument names the processor, as LLVM does: `x86-64-v3`, `neoverse-n1`; "generic" if not given.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

PROCESSOR = sys.argv[2] if len(sys.argv) > 2 else "generic"
os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = PROCESSOR, ""  # read when numba is imported

import llvmlite.binding as llvm  # noqa: E402
from numba import njit  # noqa: E402
from numba.core import types  # noqa: E402
from numba.np.arrayobj import get_cfarray_intrinsic  # noqa: E402

from shortfinal.geometry import project_kernel  # noqa: E402
from shortfinal.pose import _solve_kernel  # noqa: E402
from shortfinal.protection import _Details, _Frames, _Hypotheses, _Monitor, _protect_kernel  # noqa: E402

array: Any = get_cfarray_intrinsic("C", None)  # what numba.carray calls; that itself wants numba's runtime


def solve(  # type: ignore[no-untyped-def]
    k, rows, size, attitudes, positions, altitudes, starts, max_iterations,
    mean, cov, points, attitude, position, altitude, start, lens, work,
    position_out, rotation_out, cov_out, residual_out, jacobian_out, summary_out,
):  # fmt: skip
    """One problem of K points and n rows; of each prior and of given starts there are 0 or 1; no lines."""
    _solve_kernel(
        array(mean, (k, 2)), array(cov, (2 * k, 2 * k)), array(points, (k, 3)),
        array(mean, (0, 2)), array(mean, (0, 0)), array(mean, (0, 2, 3)),
        array(attitude, (attitudes, 18)), array(position, (positions, 12)), array(altitude, (altitudes, 2)),
        array(start, (starts, 12)), array(lens, (12,)), max_iterations, array(work, (size,)),
        array(position_out, (3,)), array(rotation_out, (3, 3)), array(cov_out, (6, 6)),
        array(residual_out, (rows,)), array(jacobian_out, (rows, 6)), array(summary_out, (5,)),
    )  # fmt: skip


def protect(  # type: ignore[no-untyped-def]
    k, rows, size, cells, risk, rate, root, fault_free, unmonitored,
    residual, jacobian, factor, position, rotation, points, lens, set_rows, priors, table, layout, work, out,
):  # fmt: skip
    """The levels of one estimate by the residual's test; one set of faulty features for each keypoint."""
    details = array(work, (3, 1, k, 5))
    _protect_kernel(
        _Frames(
            array(residual, (1, rows)), array(jacobian, (1, rows, 6)), array(factor, (1, rows, rows)),
            array(position, (1, 3)), array(rotation, (1, 3, 3)), array(points, (1, k, 3)),
            array(points, (1, 0, 2, 3)), array(points, (1, 0, 2)),
        ),
        array(lens, (12,)),
        _Hypotheses(array(set_rows, (k, 2)), array(priors, (k,)), fault_free, unmonitored),
        _Monitor(risk, rate, False, root, array(table, (cells, 4))),
        array(layout, (28,)),
        array(work, (size,))[15 * k :],
        _Details(details[0], details[1], details[2]),
        array(out, (1, 5, 5)),
    )  # fmt: skip


def project(k, points, rotation, position, lens, px, jacobian, depth):  # type: ignore[no-untyped-def]
    """Pixels of K points, their Jacobian, and depths: positive where there is a pixel."""
    project_kernel(
        array(points, (k, 3)), array(rotation, (3, 3)), array(position, (3,)), array(lens, (12,)),
        array(px, (2 * k,)), array(jacobian, (2 * k, 6)), array(depth, (k,)),
    )  # fmt: skip


COUNT, NUMBER = types.int64, types.float64
NUMBERS, COUNTS = types.CPointer(NUMBER), types.CPointer(COUNT)
# Declared once more in shortfinal.cpp.
EXPORTS = {
    solve: (COUNT,) * 8 + (NUMBERS,) * 15,
    protect: (COUNT,) * 4 + (NUMBER,) * 5 + (NUMBERS,) * 7 + (COUNTS, NUMBERS, NUMBERS, COUNTS, NUMBERS, NUMBERS),
    project: (COUNT,) + (NUMBERS,) * 7,
}


def compiled(function: Any, arguments: tuple[Any, ...]) -> Any:
    """The LLVM module of a function and all that it calls; of it only the function can be linked."""
    dispatcher = njit(types.void(*arguments), nogil=True, error_model="numpy", _nrt=False)(function)
    (result,) = dispatcher.overloads.values()
    module = llvm.parse_assembly(str(result.library._final_module))
    for item in (*module.functions, *module.global_variables):
        if item.name == result.fndesc.llvm_func_name:
            item.name = f"shortfinal_kernel_{function.__name__}"
            item.visibility = "hidden"
        elif not item.is_declaration:
            item.linkage = "internal"
    return module


def main() -> None:
    out = Path(sys.argv[1])
    first, *others = (compiled(function, arguments) for function, arguments in EXPORTS.items())
    for module in others:
        first.link_in(module)
    machine = llvm.Target.from_default_triple().create_target_machine(cpu=PROCESSOR, opt=3, reloc="pic")
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()  # what calls Python
    passes.run(first, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    out.write_bytes(machine.emit_object(first))


if __name__ == "__main__":
    main()
