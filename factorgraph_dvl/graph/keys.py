"""GTSAM's symbols: this is the only module that makes them."""

from __future__ import annotations

import string
from collections.abc import Iterable

from gtsam import Ordering, symbol, symbolChr, symbolIndex
from gtsam.symbol_shorthand import B, R, W, X

from factorgraph_dvl.geometry.vectors import IntArray

# Letters of variables that belong to a node: biases, attitudes, rates, states.
OF_NODES = "brwx"
# Chosen: all letters but those.
_LETTERS = [c for c in string.ascii_letters + string.digits if c not in OF_NODES]
# Letters of correlated errors. Chosen: what no other variable has.
_PROCESSES = string.punctuation

# Keys with the index 0; the others follow. By GTSAM's definition.
_FIRST_NODE = int(X(0))
_FIRST_BIAS = int(B(0))
_FIRST_ATTITUDE = int(R(0))
_FIRST_RATE = int(W(0))
# Dimensions of a state, attitude, position and velocity, and of the biases of accelerometers and
# gyros: those of GTSAM's NavState and ConstantBias.
STATE_SIZE = 9
BIAS_SIZE = 6


def node(k: int) -> int:
    """Return the key of the navigation state at node k."""
    return _FIRST_NODE + k


def nodes(k: IntArray) -> IntArray:
    """Return the keys of the navigation states at nodes (M,)."""
    return node(0) + k


def bias(k: int) -> int:
    """Return the key of IMU bias k."""
    return _FIRST_BIAS + k


def attitude(k: int) -> int:
    """Return the key of the attitude at node k, where it is a variable of its own."""
    return _FIRST_ATTITUDE + k


def rate(k: int) -> int:
    """Return the key of the angular rates at node k."""
    return _FIRST_RATE + k


def calibration(i: int, size: int) -> int:
    """Return the key of calibration parameter i, which has `size` components."""
    return int(symbol(letter(size), i))


def process(i: int, j: int) -> int:
    """Return the key of node j of correlated error i."""
    return int(symbol(_PROCESSES[i], j))


def correlated(k: int) -> int:
    """Return the key of all correlated errors at state k, where each state has its own."""
    return process(-1, k)


def is_process(key: int) -> bool:
    """Whether a key is that of a correlated error."""
    return letter_of(key) in _PROCESSES


def letter_of(key: int) -> str:
    """Return the letter of a key: `x` of states, `b` of biases."""
    return chr(symbolChr(key))


def index_of(key: int) -> int:
    """Return the index of a key: of a node, or of a node of a correlated error."""
    return int(symbolIndex(key))


def indices_of(same: IntArray) -> IntArray:
    """Return the indices of keys (M,) that have the same letter."""
    first = int(same[0])
    return same - first + index_of(first)


def letter(size: int) -> str:
    """Return the letter of the calibration parameters that have `size` components.

    iSAM2's thresholds go by letters, and must have the dimension of the variable.
    """
    return _LETTERS[size - 1]


def ordering(of: Iterable[int]) -> Ordering:
    """Return an order of elimination of keys."""
    out = Ordering()
    for key in of:
        out.push_back(key)
    return out
