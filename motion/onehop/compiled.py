"""Decorators of compiled functions that are called millions of times by others.

numba counts references to arrays atomically: for every slice, every array taken out of a tuple, every tuple of arrays
that is passed on. In small functions that is most of the time. These do without (numba's `_nrt=False`); so they may
not allocate, and are called by compiled functions only, which hold the arrays.
"""

from numba import njit

inner = njit(cache=True, nogil=True, _nrt=False)
# where the order of float32 operations does not matter
inner_fast = njit(cache=True, nogil=True, _nrt=False, fastmath=True)
