"""First verdicts of the network model, recomputed in Python integers without shared code."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

VECTORS = Path(__file__).resolve().parents[2] / "netsim" / "src" / "tests" / "verdicts.txt"
SEED = 0x0123_4567_89AB_CDEF
PACKETS = 256
SPACING_NS = 1_000_000

LOSS, CHAIN, OUTAGE, REORDER, DUPLICATE, CORRUPT, TRUNCATE, ATTACK = 1, 4, 5, 7, 8, 9, 10, 12
DIRECTIONS = {"forward": 0, "backward": 1}
ROWS = [line.split(" ", 2) for line in VECTORS.read_text(encoding="utf-8").splitlines() if line[0] != "#"]
KNOWN = {(name, direction): rest for name, direction, rest in ROWS}


def draw(stream: int, index: int) -> int:
    """Return 64 bits of Philox4x32-10, keyed by the seed (Salmon et al. 2011)."""
    word = 0xFFFF_FFFF
    c = [index & word, index >> 32, stream & word, stream >> 32]
    k = [SEED & word, SEED >> 32]
    for _ in range(10):
        first, second = 0xD251_1F53 * c[0], 0xCD9E_8D57 * c[2]
        c = [second >> 32 ^ c[1] ^ k[0], second & word, first >> 32 ^ c[3] ^ k[1], first & word]
        k = [(k[0] + 0x9E37_79B9) & word, (k[1] + 0xBB67_AE85) & word]
    return c[0] | c[1] << 32


def stream(impairment: int, side: int, place: int = 0) -> int:
    return impairment << 1 | side | place << 16


def at(stream: int, index: int, position: int) -> int:
    return draw(stream | 1 << 63 | position << 32, index)


def below(probability: float, bits: int) -> bool:
    return bits < int(probability * 2.0**64)


def events(impairment: int, probability: float = 0.1, place: int = 0) -> Callable[[int], Iterator[bool]]:
    def of(side: int) -> Iterator[bool]:
        return (below(probability, draw(stream(impairment, side, place), n)) for n in range(PACKETS))

    return of


def pick(law: list[float], bits: int) -> int:
    total = 0.0
    for state, share in enumerate(law):
        total += share
        if below(min(total, 1.0), bits):
            return state
    return len(law) - 1


def chain(stationary: list[float], rows: list[list[float]], side: int) -> Iterator[int]:
    law = stationary
    for n in range(PACKETS):
        state = pick(law, draw(stream(CHAIN, side), n))
        yield state
        law = rows[state]


def gilbert(side: int) -> Iterator[bool]:
    loss, burst = 0.1, 4.0
    start, stay = loss / (1 - loss) / burst, 1 - 1 / burst
    return (state == 1 for state in chain([1 - loss, loss], [[1 - start, start], [1 - stay, stay]], side))


def gilbert_elliott(side: int) -> Iterator[bool]:
    p, r, loss = 0.05, 0.2, [0.01, 0.7]
    states = chain([r / (p + r), p / (p + r)], [[1 - p, p], [r, 1 - r]], side)
    return (below(loss[state], draw(stream(LOSS, side), n)) for n, state in enumerate(states))


def four_state(side: int) -> Iterator[bool]:
    p13, p31, p32, p23, p14 = 0.05, 0.2, 0.1, 0.5, 0.02
    weights = [p31 * p23, p13 * p32, p13 * p23, p14 * p31 * p23]
    rows = [
        [1 - p13 - p14, 0.0, p13, p14],
        [0.0, 1 - p23, p23, 0.0],
        [p31, p32, 1 - p31 - p32, 0.0],
        [1.0, 0.0, 0.0, 0.0],
    ]
    return (state >= 2 for state in chain([w / sum(weights) for w in weights], rows, side))


def on_off(gap_s: float, off_share: float, key: int) -> Iterator[bool]:
    """Yield the state at each packet, true for off; it is redrawn at the times of a Poisson process, block by block."""
    block_ns = round(8 * gap_s * 1e9)
    redrawn = [(0, below(off_share, draw(key, 0)))]
    for block in range(PACKETS * SPACING_NS // block_ns + 1):
        time_ns, position = block * block_ns, 0
        while True:
            unit = ((at(key, block, 2 * position) >> 11) + 0.5) / 2**53
            time_ns += round(-math.log(unit) * gap_s * 1e9)
            if time_ns >= (block + 1) * block_ns:
                break
            redrawn.append((time_ns, below(off_share, at(key, block, 2 * position + 1))))
            position += 1
    for n in range(PACKETS):
        yield [off for time_ns, off in redrawn if time_ns <= n * SPACING_NS][-1]


def gilbert_in_time(side: int) -> Iterator[bool]:
    return on_off(0.004 * (1 - 0.1), 0.1, stream(CHAIN, side))


def outage(side: int) -> Iterator[bool]:
    return on_off(0.03 * 0.01 / 0.04, 0.01 / 0.04, stream(OUTAGE, side, 1))


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("bernoulli", events(LOSS)),
        ("gilbert", gilbert),
        ("gilbert_in_time", gilbert_in_time),
        ("gilbert_elliott", gilbert_elliott),
        ("four_state", four_state),
        ("outage", outage),
        ("reorder", events(REORDER)),
        ("duplicate", events(DUPLICATE)),
        ("corrupt", events(CORRUPT)),
        ("corrupt_copy", events(CORRUPT, place=1)),
        ("truncate", events(TRUNCATE)),
        ("attack", events(ATTACK, place=1)),
    ],
)
def test_first_verdicts(name: str, model: Callable[[int], Iterator[bool]], direction: str) -> None:
    digits = "".join("1" if happens else "0" for happens in model(DIRECTIONS[direction]))
    assert digits == KNOWN[name, direction]


def test_flipped_bits() -> None:
    """Floyd's method chooses three of the 512 bits of a packet (Bentley and Floyd 1987)."""
    flipped = []
    for n in range(PACKETS):
        chosen: set[int] = set()
        for position, last in enumerate(range(512 - 3, 512)):
            bit = at(stream(CORRUPT, 0, 2), n, position) * (last + 1) >> 64
            chosen.add(last if bit in chosen else bit)
        flipped += sorted(chosen)
    assert " ".join(map(str, flipped)) == KNOWN["flipped", "forward"]
