"""The text of the URCap's server, as a client reads it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.slave.robotiq.protocol import (
    FAULTS,
    MAX_REPLY,
    MAX_SHOWN,
    MAX_VALUE,
    MalformedReplyError,
    Progress,
    fault_text,
    get,
    parsed,
    set_,
)

PARTIAL, OPEN, WHOLE = Progress.PARTIAL, Progress.OPEN, Progress.WHOLE


def test_requests_are_lines() -> None:
    assert set_({"POS": 100, "SPE": 255, "FOR": 10, "GTO": 1}).text == b"SET POS 100 SPE 255 FOR 10 GTO 1\n"
    assert get("POS").text == b"GET POS\n"
    assert get("POS").shown == "GET POS"


@pytest.mark.parametrize(
    ("received", "reads", "progress", "value"),
    [
        (b"", None, PARTIAL, None),
        (b"a", None, PARTIAL, None),
        (b"ac", None, PARTIAL, None),
        # There is no end of line: clients compare these three bytes.
        (b"ack", None, WHOLE, None),
        (b"ack\n", None, WHOLE, None),
        (b"\nack", None, WHOLE, None),
        (b"", "POS", PARTIAL, None),
        (b"PO", "POS", PARTIAL, None),
        (b"POS ", "POS", PARTIAL, None),
        # The first two could become 10 to 199; the third is complete.
        (b"POS 1", "POS", OPEN, 1),
        (b"POS 10", "POS", OPEN, 10),
        (b"POS 100", "POS", WHOLE, 100),
        (b"POS 7\n", "POS", WHOLE, 7),
        (b"POS 7\r\n", "POS", WHOLE, 7),
        (b"\r\nPOS 007", "POS", WHOLE, 7),
        (b"STA 3", "STA", WHOLE, 3),
        (b"OBJ 0", "OBJ", WHOLE, 0),
        (b"FLT 0", "FLT", OPEN, 0),
        (b"FLT 00", "FLT", WHOLE, 0),
        (b"FLT 14", "FLT", WHOLE, 14),
    ],
)
def test_replies(received: bytes, reads: str | None, progress: Progress, value: int | None) -> None:
    assert parsed(received, reads) == (progress, value)


@pytest.mark.parametrize(
    ("received", "reads"),
    [
        (b"akc", None), (b"ackack", None), (b"ack POS", None), (b"POS 3", None), (b"?", None), (b"nack", None),
        (b"?", "POS"), (b"ack", "POS"), (b"SPE 3", "POS"), (b"POS x", "POS"), (b"POS -1", "POS"), (b"POS 1.5", "POS"),
        (b"POS 256", "POS"), (b"POS 1000", "POS"), (b"POS 1 2", "POS"), (b"POS 10 0", "POS"), (b"POS \n", "POS"),
        (b"POS\n", "POS"), (b"POS 100ack", "POS"), (b"POS \xb2", "POS"), (b"POS 100\nPOS 100", "POS"),
        # Digits alone: the server took the request for one of URScript.
        (b"100", "POS"), (b"STA 4", "STA"), (b"OBJ 33", "OBJ"), (b"FLT 16", "FLT"), (b"GTO 2", "GTO"),
        (b" " * (MAX_REPLY + 1), "POS"), (b"x" * (MAX_REPLY + 1), None),
    ],
)  # fmt: skip
def test_malformed_reply_is_refused(received: bytes, reads: str | None) -> None:
    with pytest.raises(MalformedReplyError, match="reply to ") as malformed:
        parsed(received, reads)
    assert str(malformed.value).isascii()
    assert len(str(malformed.value)) < 100 + 4 * MAX_SHOWN


@given(st.sampled_from([None, *MAX_VALUE]), st.binary(max_size=2 * MAX_REPLY))
def test_whatever_comes_is_a_reply_or_malformed(reads: str | None, received: bytes) -> None:
    for count in range(len(received) + 1):
        try:
            progress, value = parsed(received[:count], reads)
        except MalformedReplyError:
            # More bytes do not make it valid; only an end of line before a whole reply does.
            return
        assert count <= MAX_REPLY
        assert (value is not None) == (reads is not None and progress is not PARTIAL)


@given(st.sampled_from(sorted(MAX_VALUE)), st.data())
def test_every_value_is_read_in_whatever_parts_it_comes(reads: str, data: st.DataObject) -> None:
    value = data.draw(st.integers(0, MAX_VALUE[reads]))
    end = data.draw(st.sampled_from([b"", b"\n", b"\r\n"]))
    whole = f"{reads} {value}".encode() + end
    for count in range(len(whole)):
        progress, _ = parsed(whole[:count], reads)
        # A reader that stops here must not miss anything: the reply is not whole yet, except for its end of line.
        assert progress is not WHOLE or whole[count:].strip() == b""
    assert parsed(whole, reads)[1] == value


def test_every_fault_has_a_remedy() -> None:
    assert FAULTS.keys() == {5, *range(7, 16)}
    for flt in FAULTS:
        name, what, remedy = fault_text(flt).split(": ", 2)
        assert name == f"FLT {flt}"
        assert what
        assert remedy
    assert "does not name" in fault_text(6)
