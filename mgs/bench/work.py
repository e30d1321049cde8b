"""The work of a compiled kernel, counted in its LLVM IR, the code that Dr.Jit hands to LLVM.
Nothing is measured here.

A kernel of Dr.Jit is one function, which takes one SIMD register of numbers after the other. An
instruction on vectors so counts once for each lane. Most kernels are straight code. Those that
follow lists have loops, and the counts of each, those of one iteration, are kept apart. Code that
runs only under a condition counts as if it always ran.
"""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass

INSTRUCTION = re.compile(r"\s+(?:(?P<name>%[\w.]+) = )?(?:tail )?(?P<operation>\w+)(?P<rest>.*)")
VECTOR = re.compile(r"<(\d+) x (\w+)>")
CALLED = re.compile(r"@([\w.]+)\(")
PACKET = re.compile(r"(?:gather|scatter)(?P<add>_add)?_(?P<count>\d+)x[a-z](?P<bits>\d+)")
ADDED = re.compile(r"reduce_\w+?_[a-z](?P<bits>\d+)")
SCATTERED = ("masked", "gather_", "scatter_", "reduce_")
"""Beginnings of the operations that load and store at an address of each lane's own."""

MEMORY = ("load", "store", "memcpy", *SCATTERED)
"""Beginnings of the operations that load and store; their bytes are counted."""

FREE = (
    "alloca",
    "phi",
    "getelementptr",
    "bitcast",
    "insert",
    "extract",
    "shufflevector",
    "fneg",
    "vector",
)
"""Beginnings of the operations that are not counted: they name values and addresses or spread a
constant over the lanes, become part of an FMA (a change of sign), or occur once in a loop (what
reduces a mask to one bit)."""

BITWISE = ("and", "or", "lshr", "zext", "bitcast")
"""Operations that count for nothing where their result is not used."""

FLOPS = {"fadd": 1, "fsub": 1, "fmul": 1, "fdiv": 1, "sqrt": 1, "rcp": 1, "rsqrt": 1, "fma": 2}
"""Floating-point operations; all others have none. `rcp` and `rsqrt` are the processor's
approximations."""


@dataclass(frozen=True)
class Work:
    """Operations and bytes of one lane.

    flops, flops64: floating-point operations in single and in double precision; an FMA is two, a
    comparison none.
    divisions, divisions64: how many of these are divisions or square roots, which take a processor
    much longer.
    instructions: vector instructions other than loads and stores; one on 64-bit numbers fills two
    registers and counts twice.
    bytes: loaded from arrays and stored in them.
    state_bytes: of what a loop carries along. Read and written: its variables, and its local arrays
    at each access. Read: what was computed before it, the same for all iterations.
    addresses: at which a lane reads or writes arrays by itself, each perhaps in another line of the
    cache; a packet is one.
    """

    flops: float = 0
    flops64: float = 0
    divisions: float = 0
    divisions64: float = 0
    instructions: float = 0
    bytes: float = 0
    state_bytes: float = 0
    addresses: float = 0

    def __add__(self, other: Work) -> Work:
        return Work(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def __mul__(self, times: float) -> Work:
        return Work(*(times * a for a in astuple(self)))


@dataclass(frozen=True)
class KernelWork:
    """Work of one lane of a kernel. straight: outside of loops. loops: of one iteration of each
    loop, in their order. width: lanes of a register."""

    straight: Work
    loops: tuple[Work, ...]
    width: int


def count_work(ir: str) -> KernelWork:
    """Count the work of a kernel. ir: its LLVM IR, as Dr.Jit's kernel history holds it.

    A loop that runs a constant number of times, as one that fills a local array, counts as if it
    were written out. What only computes bits that are always zero does not count
    (`_without_zero_bits`). Raises ValueError if ir holds no kernel, or one with a loop inside a
    loop, whose iterations have no common number.
    """
    lines = _without_zero_bits(_kernel_lines(ir))
    step = re.search(r"= add i64 %index, (\d+)", "\n".join(lines))
    if step is None:
        raise ValueError("no kernel of Dr.Jit in this code")
    loops, constant = _loops(lines)
    if any(a != b and a[0] <= b[0] <= a[1] for a in loops for b in loops):
        raise ValueError("a loop inside a loop: its iterations have no common number")
    reader, straight, header = _Reader(int(step[1])), Work(), False
    works = [Work()] * len(loops)
    for number, line in enumerate(lines):
        if line.endswith(":"):
            header = any(start == number for start, _ in loops)
        found = reader.read(line, header) * next(
            (n for (start, end), n in constant.items() if start <= number <= end), 1
        )
        inside = next((k for k, (start, end) in enumerate(loops) if start <= number <= end), None)
        if inside is None:
            straight += found
            reader.remember(line)
        else:
            works[inside] += found + reader.taken_over(line)
    return KernelWork(straight, tuple(works), reader.width)


def _kernel_lines(ir: str) -> list[str]:
    """Lines of the kernel's own function; those that it calls stand behind it. Metadata at the ends
    of lines are left out."""
    lines = [line.partition(", !")[0] for line in ir.splitlines()]
    start = next(
        (i for i, line in enumerate(lines) if line.startswith("define void @drjit_")), len(lines)
    )
    return lines[start + 1 : lines.index("}", start) if start < len(lines) else None]


def _without_zero_bits(lines: list[str]) -> list[str]:
    """The lines without those that LLVM drops because they compute (x & 1) >> 1, which is always
    zero, or add that to a number: so `mgs.splat.walking.computed_after` puts pixels in order."""
    ones: set[str] = set()
    odd: set[str] = set()
    zeros: set[str] = set()
    kept = []
    for line in lines:
        name, operation, rest = _parts(line)
        used = re.findall(r"%[\w.]+", rest)
        if re.search(r"undef, i\d+ 1, i32 0$", rest) or (
            operation == "shufflevector" and used[0] in ones
        ):
            ones.add(name)
        elif operation == "and" and ones & set(used):
            odd.add(name)
        elif operation == "lshr":
            if len(used) == 2 and used[0] in odd and used[1] in ones:
                zeros.add(name)
        elif operation in ("zext", "or") and used and set(used) <= zeros:
            zeros.add(name)
        elif operation == "or" and len(used) == 2 and zeros & set(used):
            (other,) = set(used) - zeros
            kind = rest.strip().partition(" %")[0]
            line = f"    {name} = bitcast {kind} {other} to {kind}"
        kept.append(line)
    return _without_unused(kept)


def _without_unused(lines: list[str]) -> list[str]:
    """The lines without those whose result, a bitwise operation on numbers, no other line reads."""
    while True:
        read = {name for line in lines for name in re.findall(r"%[\w.]+", _parts(line)[2])}
        found = [(line, _parts(line)) for line in lines]
        kept = [
            line
            for line, (name, operation, _) in found
            if not (operation in BITWISE and name not in read)
        ]
        if len(kept) == len(lines):
            return lines
        lines = kept


def _loops(lines: list[str]) -> tuple[list[tuple[int, int]], dict[tuple[int, int], int]]:
    """First and last line of each loop; and of each loop that runs a constant number of times, with
    this number.

    A loop is a jump backwards, except for the jump to `body`, which goes on to the next register.
    """
    labels = {line[:-1]: i for i, line in enumerate(lines) if line.endswith(":")}
    loops, constant = [], {}
    for i, line in enumerate(lines):
        for label in (
            re.findall(r"label %([\w.]+)", line) if line.lstrip().startswith("br ") else []
        ):
            if label == "body" or labels[label] > i:
                continue
            times = re.search(r"icmp ult i64 %[\w.]+, (\d+)$", lines[i - 1])
            if times:
                constant[labels[label], i] = int(times[1])
            else:
                loops.append((labels[label], i))
    return loops, constant


class _Reader:
    """Reads the lines of a kernel one after the other. width: lanes of a register.

    It remembers which pointers lead to local arrays and to which place, which places lie in a
    register because they were just read or written, and which vectors were made before a loop.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._local: dict[str, str] = {}
        self._held: set[str] = set()
        self._before: dict[str, float] = {}

    def read(self, line: str, header: bool) -> Work:
        """The work of one line. header: whether it stands in a loop's first block, where `phi`
        names the loop's variables."""
        name, operation, rest = _parts(line)
        local = next(
            (self._local[used] for used in re.findall(r"%[\w.]+", rest) if used in self._local), ""
        )
        if operation == "alloca" or (operation == "getelementptr" and local):
            self._local[name] = rest
        if operation == "phi" and header:
            self._held.clear()  # another iteration begins
            return Work(state_bytes=2 * self._bytes(rest))
        if operation.startswith(MEMORY):
            size = self._moved(operation, rest)
            if not local:
                return Work(bytes=size, addresses=operation.startswith(SCATTERED))
            known = (
                operation == "load" and local in self._held
            )  # so before a write under a mask, which blends with the old value
            self._held.add(local)
            return Work() if known else Work(state_bytes=size)
        return Work() if operation.startswith(FREE) else self._arithmetic(operation, rest)

    def remember(self, line: str) -> None:
        """Take note of the vector that a line before a loop makes. A constant that is spread over
        the lanes is none."""
        name, operation, rest = _parts(line)
        if name and operation not in ("shufflevector", "getelementptr", "fcmp", "icmp"):
            kept = (
                rest.rpartition(" to ")[2] if " to " in rest else rest.partition("i1>")[2] or rest
            )
            self._before[name] = self._bytes(kept)

    def taken_over(self, line: str) -> Work:
        """What a line inside a loop reads of the vectors made before it. Each counts once."""
        _, operation, rest = _parts(line)
        names = [] if operation == "phi" else re.findall(r"%[\w.]+", rest)
        return Work(state_bytes=sum(self._before.pop(name, 0) for name in names))

    def _bits(self, text: str) -> list[int]:
        """Bits of a lane's number in each vector that the text names."""
        size = {"float": 32, "double": 64, "half": 16, "ptr": 64}
        return [
            size.get(kind) or int(kind[1:])
            for lanes, kind in VECTOR.findall(text)
            if int(lanes) == self.width
        ]

    def _bytes(self, text: str) -> int:
        """Bytes of a lane's number in the first vector that the text names; of a mask none."""
        return next(iter(self._bits(text)), 0) // 8

    def _arithmetic(self, operation: str, rest: str) -> Work:
        bits = self._bits(rest)
        if not bits:
            return Work()  # an operation on one number for all lanes
        flops, divisions, instructions = (
            FLOPS.get(operation, 0),
            operation in ("fdiv", "sqrt"),
            1 + (max(bits) == 64),
        )
        if bits[0] == 64:
            return Work(flops64=flops, divisions64=divisions, instructions=instructions)
        return Work(flops=flops, divisions=divisions, instructions=instructions)

    def _moved(self, operation: str, rest: str) -> float:
        """Bytes of a lane that an operation of MEMORY loads and stores."""
        if packet := PACKET.match(operation):
            return (2 if packet["add"] else 1) * int(packet["count"]) * int(packet["bits"]) / 8
        if added := ADDED.match(operation):
            return 2 * int(added["bits"]) / 8
        if operation == "memcpy":
            copied = re.search(r"i(?:32|64) (\d+), i1", rest)
            return 2 * int(copied[1]) / self.width if copied else 0
        return self._bytes(rest)


def _parts(line: str) -> tuple[str, str, str]:
    """Name of the result, operation and operands of a line; of a call the function's name is the
    operation."""
    match = INSTRUCTION.match(line)
    if match is None:
        return "", "", ""
    operation, called = match["operation"], CALLED.search(match["rest"])
    if operation == "call" and called:
        operation = called[1].removeprefix("llvm.").split(".")[0]
        if operation == "x86":
            operation = re.sub(r"14.*", "", called[1].split(".")[3])
    return match["name"] or "", operation, match["rest"]
