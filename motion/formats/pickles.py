"""Reads the pickled object of a `.npy` object array without running anything that the file asks for.

A pickle is a program. Here it finds no name but the handful that a dictionary of arrays needs, and numpy's own are
stood in for by the classes below, because numpy trusts a pickled state: an object `dtype` whose flags were cleared
makes `ndarray` take raw bytes for pointers (numpy 2.4: a crash at the first look at the array, or worse).
"""

import math
import pickle
from collections import OrderedDict

import numpy as np

from motion.errors import InputError

_NUMBERS = {kind + size for kind in "fiu" for size in "248"} | {"i1", "u1", "b1"}


def load_object_array(path):
    """The one object in the `.npy` file `path`: plain Python values, with arrays of numbers as read-only ndarrays.

    Raises InputError, naming the file, for another kind of file, a damaged one, and one that names anything else than
    OrderedDict and numpy's ndarray, dtype, _reconstruct and scalar.
    """
    with open(path, "rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"npy format {version}")
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(file)
        except ValueError as error:
            raise InputError(f"{path}: is not a npy file ({_line(error)}); export the clip again") from error
        if not dtype.hasobject or math.prod(shape) != 1:
            raise InputError(
                f"{path}: holds an array {shape} of {dtype}, not a poselib SkeletonMotion; export the clip as one"
            )
        try:
            return _plain(_Unpickler(file, path).load().items[0])
        except InputError:
            raise
        except Exception as error:  # a damaged pickle can raise nearly anything
            raise InputError(f"{path}: is damaged or cut short ({_line(error)}); copy or export it again") from error


def _line(error):
    return " ".join(f"{type(error).__name__}: {error}".split())[:120]


def _plain(value):
    """`value` with every stand-in array replaced by the array itself."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value.numbers if isinstance(value, _Array) else value


class _Unpickler(pickle.Unpickler):
    def __init__(self, file, path):
        super().__init__(file)
        self._path = path

    def find_class(self, module, name):
        found = _ALLOWED.get((module, name))
        if found is None:
            asked = " ".join(f"{module}.{name}".split())[:80]
            raise InputError(
                f"{self._path}: asks for {asked}, which no motion clip needs: refused without running it; get the clip"
                " from a source that you trust"
            )
        return found


class _NdarrayName:
    """Stands for numpy.ndarray, which such a pickle names but never calls."""

    def __init__(self, *_):
        raise ValueError("an array made by other means than numpy's own")


class _Dtype:
    """Stands for numpy.dtype: a kind of number (`numbers`), or Python objects (None)."""

    def __init__(self, name, align=False, copy=False):
        if name not in _NUMBERS and name not in ("O", "O8"):
            raise ValueError(f"an array of {name!r}")
        self.numbers = None if name.startswith("O") else np.dtype(name)

    def __setstate__(self, state):
        # the byte order is all that a plain type's state says
        if self.numbers is not None:
            self.numbers = self.numbers.newbyteorder(state[1])


class _Array:
    """Stands for numpy.ndarray's instances: `items` of an object array, or `numbers`."""

    def __setstate__(self, state):
        _, shape, dtype, fortran, content = state
        if not isinstance(dtype, _Dtype):
            raise TypeError("an array without a type")
        if dtype.numbers is None:
            self.items = list(content)
        else:
            self.numbers = np.frombuffer(content, dtype.numbers).reshape(shape, order="F" if fortran else "C")


def _reconstruct(subtype, shape, kind):
    return _Array()


def _scalar(dtype, content):
    return np.frombuffer(content, dtype.numbers)[0]


_ALLOWED = {
    ("collections", "OrderedDict"): OrderedDict,
    ("numpy", "ndarray"): _NdarrayName,
    ("numpy", "dtype"): _Dtype,
}
for _module in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _ALLOWED[_module, "_reconstruct"] = _reconstruct
    _ALLOWED[_module, "scalar"] = _scalar
