"""Integers as bytes by adaptive range coding (constriction). One function serves both directions: a
decoder gets zeros in place of the numbers."""

from collections.abc import Callable
from typing import Any

import numpy as np

from mgs.errors import InputError, missing

Stream = Callable[[np.ndarray, Any], np.ndarray]
"""(symbols, probability model) -> the symbols: those given, or as many that are read."""

FINER = 4  # steps of a layer over those of the next
CLASSES = 21  # numbers of bits of a magnitude: 0 to 20
LARGEST = (1 << (CLASSES - 1)) - 1  # largest magnitude that is coded
FIRST_BLOCK, LAST_BLOCK = 16, 4096  # symbols coded with the same probabilities, doubled to the last
UNSEEN = 0.02  # count of a symbol that was never coded
FIRST_COUNTS = 4.0  # count of the smallest symbol before any; each further one has half of that
CARRIED = 32.0  # most counts with which a further column begins


def _library() -> Any:
    try:
        import constriction
    except ImportError:
        raise InputError(missing("constriction")) from None
    return constriction.stream


def encode(write: Callable[[Stream], object]) -> bytes:
    """Bytes of all that write(stream) codes."""
    coder = _library().queue.RangeEncoder()

    def stream(symbols: np.ndarray, model: Any) -> np.ndarray:
        coder.encode(np.ascontiguousarray(symbols, np.int32), model)
        return symbols

    write(stream)
    return bytes(coder.get_compressed().astype("<u4").tobytes())


def decoder(data: bytes) -> Stream:
    """Stream that reads bytes of `encode`. It raises ValueError where they are no such bytes."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4").astype(np.uint32)
    coder = _library().queue.RangeDecoder(words)

    def stream(symbols: np.ndarray, model: Any) -> np.ndarray:
        try:
            return np.asarray(coder.decode(model, len(symbols)), np.int64)
        except AssertionError as error:
            raise ValueError(str(error)) from None

    return stream


def adaptive(stream: Stream, symbols: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Code symbols [n] from 0 to K-1. counts: [K] of those before, which are updated in place."""
    result, at, size = np.zeros(len(symbols), np.int64), 0, FIRST_BLOCK
    categorical = _library().model.Categorical
    while at < len(symbols):
        block = slice(at, at + size)
        model = categorical((counts + UNSEEN) / (counts + UNSEEN).sum(), perfect=False)
        result[block] = stream(symbols[block], model)
        counts[:] = counts / 2 + np.bincount(result[block], minlength=len(counts))
        at, size = at + size, min(2 * size, LAST_BLOCK)
    return result


def flag(stream: Stream, value: bool) -> bool:
    """Code one bit."""
    return bool(stream(np.array([value], np.int64), _library().model.Uniform(2))[0])


def integers(stream: Stream, values: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Code integers [n,C] of magnitudes up to LARGEST, column by column, of which before [n,C] are
    known: the magnitudes without their last digit to base FINER, and signs. Where that is not 0,
    the digit is coded adaptively. Elsewhere the number of bits of a magnitude is; then sign and
    lower bits as they are. A column begins with the counts of the one before it."""
    result = np.zeros(values.shape, np.int64)
    uniform = _library().model.Uniform
    counts = {size: FIRST_COUNTS * 0.5 ** np.arange(size) for size in (FINER, CLASSES)}
    for column in range(values.shape[1]):
        known = before[:, column] != 0
        least = FINER * np.abs(before[known, column])
        digits = np.abs(values[known, column]) - least
        digits = adaptive(stream, digits, counts[FINER])
        result[known, column] = np.sign(before[known, column]) * (least + digits)
        rows = np.flatnonzero(~known)
        part = values[rows, column]
        classes = adaptive(stream, np.frexp(np.abs(part))[1], counts[CLASSES])
        for bits in range(1, int(classes.max(initial=0)) + 1):
            of = np.flatnonzero(classes == bits)
            if len(of):
                least = 1 << (bits - 1)
                code = 2 * (np.abs(part[of]) - least) + (part[of] < 0)
                code = stream(code, uniform(1 << bits))
                result[rows[of], column] = (code // 2 + least) * (1 - 2 * (code % 2))
        counts = {size: part * min(1, CARRIED / part.sum()) for size, part in counts.items()}
    return result
