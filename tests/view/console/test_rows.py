"""The rows of the charts: each page advances by itself."""

from haptether.view.console.rows import Rows


def test_a_slow_page_loses_the_oldest_counted_and_no_other_does() -> None:
    rows = Rows(3)
    seen = 0
    for number in range(1, 11):
        rows.add({"t": number})
        assert rows.since(seen) == ([{"t": number}], 0)
        seen = rows.newest
    assert rows.since(seen) == ([], 0)
    assert rows.since(8) == ([{"t": 9}, {"t": 10}], 0)
    assert rows.since(2) == ([{"t": 8}, {"t": 9}, {"t": 10}], 5)
