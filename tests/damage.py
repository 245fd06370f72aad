"""Damage for the tests of readers: bytes and JSON changed at random, and memory watched."""

import copy
import tracemalloc
from contextlib import contextmanager

from hypothesis import strategies as st

_NUMBERS = st.one_of(
    st.integers(-3, 300), st.sampled_from([2**31, 2**32, 2**53, 10**400, -1, 0]),
    st.floats(allow_nan=False, allow_infinity=False), st.booleans())
VALUES = st.recursive(
    st.one_of(_NUMBERS, st.none(), st.sampled_from(["", "a", "meta.json", "../x", "VEC3"])),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(
        st.sampled_from(["count", "files", "mode", "0"]), inner, max_size=3)), max_leaves=5)


@contextmanager
def little_memory(most=48 << 20):
    """Fails where more than `most` bytes are taken at a time."""
    tracemalloc.start()
    try:
        yield
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < most


@st.composite
def changed_bytes(draw, data):
    """Returns the bytes with some of them overwritten, cut out or doubled."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(changed) - 1)))
        kind = draw(st.sampled_from(["set", "cut", "add", "end"]))
        if kind == "set":
            changed[at:at + 4] = draw(st.binary(min_size=1, max_size=4))
        elif kind == "cut":
            del changed[at:at + draw(st.integers(1, 40))]
        elif kind == "add":
            changed[at:at] = changed[at:at + draw(st.integers(1, 40))]
        else:
            del changed[at:]
    return bytes(changed)


def places(value, before=()):
    """Returns the path of every entry of JSON."""
    entries = value.items() if isinstance(value, dict) else enumerate(
        value[:3] if isinstance(value, list) else ())
    return [path for key, inner in entries
            for path in [(*before, key), *places(inner, (*before, key))]]


@st.composite
def changed_json(draw, value):
    """Returns JSON in which a few entries are something else, or gone."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        paths = places(value)
        if not paths:
            break
        *above, key = draw(st.sampled_from(paths))
        inner = value
        for step in above:
            inner = inner[step]
        if draw(st.integers(0, 3)):
            inner[key] = draw(VALUES)
        else:
            del inner[key]
    return value
