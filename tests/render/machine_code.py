"""Reads x86 assembler as LLVM prints it: the loops of a function and the arithmetic in each.

LLVM lays blocks out in any order, so a loop is not what stands between a label and a jump back to
it. Loops are found in the graph of blocks, by dominators (Aho et al. 2006, section 9.6).
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import chain

_LABEL = re.compile(r"^(\.L\w+|[A-Za-z_\"][^\s:]*\"?):")
_TARGET = re.compile(r"^j\w+\s+(\.L\w+)")
_ARITHMETIC = re.compile(r"^v?(?:add|sub|mul|div|sqrt|fn?m(?:add|sub)\d*)(p|s)[sd]$")
_CONTINUES = re.compile(r"^(?!jmp|ret|ud2)")
_SYMBOL = re.compile(r"^movabsq\s+\$([A-Za-z_]\w*), (%\w+)")
_TABLE = re.compile(r"^\t\.(?:long|quad)\t(\.L\w+)")


@dataclass
class Loop:
    """The blocks of a loop that belong to no loop inside it.

    Attributes:
        label: of the first block.
        packed: operations on float vectors by the kind of register: zmm, ymm or xmm.
        scalar: operations on single floats.
        shifts_by_23: shifts of whole vectors by 23 bits, which exp2 and log2 are made with.
        calls: names of what may be called; any function whose address the register of a call
            ever holds.
    """

    label: str
    packed: Counter[str] = field(default_factory=Counter)
    scalar: int = 0
    shifts_by_23: int = 0
    calls: set[str] = field(default_factory=set)

    @property
    def arithmetic(self) -> int:
        """Operations on floats of any kind."""
        return self.packed.total() + self.scalar


def loops(assembler: str) -> list[Loop]:
    """Returns all loops of the functions in a text, those with the most arithmetic first."""
    found = []
    for function in _functions(assembler):
        blocks, follows = _graph(function)
        symbols: dict[str, set[str]] = defaultdict(set)
        for match in filter(None, map(_SYMBOL.match, chain(*blocks.values()))):
            symbols[match[2]].add(match[1])
        bodies = _natural_loops(blocks, follows)
        for header, body in bodies.items():
            inner = set().union(*(
                other for first, other in bodies.items()
                if first != header and first in body and len(other) < len(body)))
            loop = Loop(header)
            for label in blocks:
                if label in body - inner:
                    _count(loop, blocks[label], symbols)
            found.append(loop)
    return sorted(found, key=lambda loop: -loop.arithmetic)


def _functions(assembler: str) -> list[list[str]]:
    """Splits a text at the directives that begin and end functions."""
    found: list[list[str]] = []
    for line in assembler.splitlines():
        if "@function" in line:
            found.append([])
        if found:
            found[-1].append(line)
    return found


def _graph(function: list[str]) -> tuple[dict[str, list[str]], dict[str, set[str]]]:
    """Returns the instructions of each block and the blocks that may follow it."""
    blocks: dict[str, list[str]] = {"entry": []}
    follows: dict[str, set[str]] = defaultdict(set)
    table = {match[1] for match in map(_TABLE.match, function) if match}
    here, runs_on = "entry", True
    for line in function:
        label = _LABEL.match(line)
        if label:
            if runs_on:
                follows[here].add(label[1])
            here, runs_on = label[1], True
            blocks.setdefault(here, [])
        elif line.startswith("\t") and not line.startswith("\t."):
            instruction = line.strip()
            if not runs_on:  # a block without a label, after a jump
                continue
            blocks[here].append(instruction)
            target = _TARGET.match(instruction)
            if target:
                follows[here].add(target[1])
                if not instruction.startswith("jmp"):  # what comes after is a block of its own
                    rest = f"{here}'"
                    follows[here].add(rest)
                    blocks[rest] = []
                    here = rest
            elif instruction.startswith("jmp"):  # through a table; any of its targets
                follows[here] |= table
            runs_on = bool(_CONTINUES.match(instruction))
    return blocks, follows


def _natural_loops(
    blocks: dict[str, list[str]], follows: dict[str, set[str]]
) -> dict[str, set[str]]:
    """Returns the blocks of each loop by its first block."""
    before: dict[str, set[str]] = defaultdict(set)
    order, waiting = ["entry"], ["entry"]
    while waiting:
        here = waiting.pop()
        for there in follows[here] & blocks.keys():
            before[there].add(here)
            if there not in order:
                order.append(there)
                waiting.append(there)
    every = set(order)
    over = {label: {label} if label == "entry" else every for label in order}
    changed = True
    while changed:
        changed = False
        for label in order[1:]:
            new = set.intersection(*(over[b] for b in before[label])) | {label}
            changed, over[label] = changed or new != over[label], new
    bodies: dict[str, set[str]] = defaultdict(set)
    for end in order:
        for first in follows[end] & over[end]:
            bodies[first] |= _reaching(end, first, before)
    return bodies


def _reaching(end: str, first: str, before: dict[str, set[str]]) -> set[str]:
    body, waiting = {first, end}, [end] if end != first else []
    while waiting:
        for label in before[waiting.pop()] - body:
            body.add(label)
            waiting.append(label)
    return body


def _count(loop: Loop, instructions: list[str], symbols: dict[str, set[str]]) -> None:
    for instruction in instructions:
        name, _, operands = instruction.partition("\t")
        arithmetic = _ARITHMETIC.match(name)
        if arithmetic and arithmetic[1] == "p":
            loop.packed[next(k for k in ("zmm", "ymm", "xmm") if k in operands)] += 1
        elif arithmetic:
            loop.scalar += 1
        elif "pslld" in name and "$23" in operands:
            loop.shifts_by_23 += 1
        elif name.startswith("call"):
            loop.calls |= symbols.get(operands.lstrip("*"), {operands})
