"""numba's compiler, its cache in a folder and without kernels of other sources, and Phi for kernels."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.compilation import choose_cache_folder, discard_stale_kernels
from startrack.core.memory import check_memory
from startrack.core.statistics import CDF_REACH, CDF_STEPS, NORMAL_CDF
from startrack.core.stored import read_sealed, with_seal

KEPT = {} if choose_cache_folder() else {"cache": False}  # options of each kernel
discard_stale_kernels()

import numba  # noqa: E402 - it reads where its cache lies when it loads
from llvmlite.binding import Linkage, add_symbol, parse_bitcode  # noqa: E402
from numba.core.caching import FunctionCache, IndexDataCacheFile  # noqa: E402
from numba.core.codegen import JITCodeLibrary  # noqa: E402
from numba.core.registry import CPUDispatcher  # noqa: E402
from numba.core.runtime._nrt_python import c_helpers  # noqa: E402
from numba.extending import overload  # noqa: E402, F401 - for kernels that choose code by types

LOG = logging.getLogger(__name__)
WARNED: set[str] = set()  # texts logged by this process
REORDERED_SUMS = {"reassoc", "contract", "nsz"}  # as `fastmath`: lets the compiler sum several pixels at a time
PYTHON_WRAPPER = "_ZN7cpython"  # begin of the name by which Python calls


class KernelLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code of a kernel, which calls no other library: the same whether compiled here or loaded from a cache.

    Of code from a cache only compilation of a caller parses the bitcode: half of 4 ms.
    """

    _bitcode: bytes | None = None

    def _finalize_final_module(self) -> None:
        """Make the functions of other libraries in this one internal, once it is optimised, and make the code.

        Otherwise the kernel would call those of their own library where this process has compiled it. They were
        optimised apart from it: sums of reordered terms are rounded otherwise.
        """
        functions = [one for one in self._final_module.functions if not one.is_declaration]
        if any(one.name.startswith(PYTHON_WRAPPER) for one in functions):
            for function in functions:
                if function.linkage == Linkage.linkonce_odr:
                    function.linkage = Linkage.internal
        super()._finalize_final_module()

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> KernelLibrary:
        name, _, (object_code, bitcode) = state
        self = cls(codegen, name)
        self.enable_object_caching()
        self._set_compiled_object(object_code)
        self._finalize_final_module()
        self._bitcode = bitcode
        return self

    def get_pointer_to_function(self, name: str) -> int:
        """The address of a function of the library, 0 where there is none of that name."""
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
    """Have a `codegen` make and load libraries of kernels, and tell LLVM where the functions of numba's runtime are.

    Raises BadInput (out_of_memory) where the limit of address space is too small for it.
    """
    check_memory()
    codegen._library_class = KernelLibrary
    for name, address in c_helpers.items():
        add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def warn_of_cache(text: str, folder: str) -> None:
    """Log a `text` about the `folder` of compiled code, once a process."""
    if text not in WARNED:
        WARNED.add(text)
        LOG.warning("%s (%s)", text, Path(folder).parent)


class Damaged(Exception):
    """A file of compiled code has changed since it was written."""


class SealedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """numba's index and data files of a kernel, sealed: damaged machine code would end the process, or err."""

    @contextmanager
    def _open_for_write(self, path: str) -> Iterator[io.BytesIO]:
        with super()._open_for_write(path) as file:
            yield (data := io.BytesIO())
            file.write(with_seal(data.getvalue()))

    def _load_index(self) -> Any:
        self._check(self._index_path)
        return super()._load_index()

    def _load_data(self, name: str) -> Any:
        self._check(self._data_path(name))
        return super()._load_data(name)

    def _check(self, path: str) -> None:
        if os.path.exists(path) and read_sealed(path) is None:
            raise Damaged


class KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a kernel, which loads it without all that compilation needs: that takes 0.2 s."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file.__class__ = SealedFiles

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for arguments of types `sig` in a `target_context`; None where there is none yet."""
        prepare_loading(target_context.codegen())
        try:
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
        except Damaged:
            warn_of_cache("a file of compiled code is damaged: compiled anew", self.cache_path)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the compiled kernel `data` for arguments of types `sig`, where the disk takes it."""
        try:
            super().save_overload(sig, data)
        except (OSError, Damaged) as cause:
            why = getattr(cause, "strerror", "damaged files remain")
            warn_of_cache(f"compiled code cannot be kept ({why}): every command compiles", self.cache_path)


class InnerKernel(CPUDispatcher):  # type: ignore[misc]
    """A kernel that only kernels call: no code reads Python's arguments, which takes longer to compile than a loop."""

    def __call__(self, *args: Any) -> Any:
        """Refuse; without that code the call would end the process."""
        raise TypeError(f"{self.py_func.__name__} is called by kernels only; Python may call its `py_func`")


def njit(*, inner: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba's decorator with its `options`; kernels with `cache` are kept in a KernelCache, `inner`: an InnerKernel.

    All kernels release the GIL, and divide by zero as numpy does. numba compiles the functions of its own that a
    kernel uses, as np.empty, once for all kernels of equal options.
    """
    common = (
        {"no_cfunc_wrapper": True, "no_cpython_wrapper": inner, "nogil": True, "error_model": "numpy"} | options | KEPT
    )

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**common)(function)  # type: ignore[call-overload]
        if common.get("cache"):
            kernel._cache = KernelCache(function)
        if inner:
            kernel.__class__ = InnerKernel
        return kernel

    return decorate


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A contiguous array that cannot be written to, for kernels: another layout or flag would compile them again."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@njit(cache=True, inline="always")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """The normal distribution function Phi(x) by linear interpolation of a table, to 5e-7."""
    at = (min(max(x, -CDF_REACH), CDF_REACH) + CDF_REACH) * (CDF_STEPS / (2 * CDF_REACH))
    i = min(int(at), CDF_STEPS - 1)
    return NORMAL_CDF[i] + (at - i) * (NORMAL_CDF[i + 1] - NORMAL_CDF[i])


@njit(inline="always")
def rows_beside(y, side, count):  # type: ignore[no-untyped-def]
    """Indices of the rows, of `count`, of a SmoothImage on either side of row y, and the part of the second one."""
    at = min(max((y + 0.5) / side - 0.5, 0.0), count - 1.0)
    low = int(at)
    return low, min(low + 1, count - 1), np.float32(at - low)
