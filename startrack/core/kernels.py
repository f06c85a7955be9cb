"""numba's compiler, its cache in a folder and without kernels of other sources, and Phi for kernels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import erfc, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.compilation import choose_cache_folder, discard_stale_kernels

choose_cache_folder()
discard_stale_kernels()

import numba  # noqa: E402 - it reads where its cache lies when it loads
from llvmlite.binding import add_symbol, parse_bitcode  # noqa: E402
from numba.core.caching import FunctionCache  # noqa: E402
from numba.core.codegen import JITCodeLibrary  # noqa: E402
from numba.core.runtime._nrt_python import c_helpers  # noqa: E402

REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # as `fastmath`: lets the compiler sum several pixels at a time
REACH, CDF_STEPS = 8.0, 4096  # of `normal_cdf`: standard deviations on either side, and steps of the table
TABLE = np.array([0.5 * erfc(-x / sqrt(2.0)) for x in np.linspace(-REACH, REACH, CDF_STEPS + 1)])


class LazyLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code from a cache. Only compilation of a caller parses its bitcode: half of 4 ms."""

    _bitcode: bytes | None = None

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> LazyLibrary:
        name, _, (object_code, bitcode) = state
        self = cls(codegen, name)
        self.enable_object_caching()
        self._set_compiled_object(object_code)
        self._finalize_final_module()
        self._bitcode = bitcode
        return self

    def get_pointer_to_function(self, name: str) -> int:
        """The address of a function of the library; of those from a cache all that are asked for are there."""
        if self._bitcode is None:
            return int(super().get_pointer_to_function(name))
        return int(self._codegen._engine.get_function_address(name))

    def _get_module_for_linking(self) -> Any:
        if self._bitcode is not None and self._shared_module is None:
            self._shared_module = parse_bitcode(self._bitcode)
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return super()._get_module_for_linking()


@cache
def prepare_loading(codegen: Any) -> None:
    """Have a `codegen` load lazy libraries, and tell LLVM where the functions of numba's runtime are."""
    codegen._library_class = LazyLibrary
    for name, address in c_helpers.items():
        add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a kernel, which loads it without all that compilation needs: that takes 0.2 s."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for arguments of types `sig` in a `target_context`; None where there is none yet."""
        prepare_loading(target_context.codegen())
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba's decorator with its `options`; kernels with `cache` are kept in a KernelCache."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(no_cfunc_wrapper=True, **options)(function)  # type: ignore[call-overload]
        if options.get("cache"):
            kernel._cache = KernelCache(function)
        return kernel

    return decorate


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A contiguous array that cannot be written to, for kernels: another layout or flag would compile them again."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@njit(cache=True, nogil=True, inline="always")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """The normal distribution function Phi(x) by linear interpolation of a table, to 5e-7."""
    at = (min(max(x, -REACH), REACH) + REACH) * (CDF_STEPS / (2 * REACH))
    i = min(int(at), CDF_STEPS - 1)
    return TABLE[i] + (at - i) * (TABLE[i + 1] - TABLE[i])


@njit(inline="always")
def rows_beside(y, side, count):  # type: ignore[no-untyped-def]
    """Indices of the rows, of `count`, of a SmoothImage on either side of row y, and the part of the second one."""
    at = min(max((y + 0.5) / side - 0.5, 0.0), count - 1.0)
    low = int(at)
    return low, min(low + 1, count - 1), np.float32(at - low)
