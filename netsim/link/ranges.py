"""Numbers of a link with their ranges, which validation, messages and tools read from the types."""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta

LONGEST_S = 3600.0
"""Longest delay that a link accepts."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[float, Meta(ge=0.0, le=LONGEST_S)]
Time = Annotated[float, Meta(ge=0.0, le=1e9)]
"""In s since the link began, or between two things that happen."""
Length = Annotated[float, Meta(gt=0.0, le=1e9)]
"""In s, of something that lasts."""
Burst = Annotated[float, Meta(ge=1.0, le=1e9)]
Rate = Annotated[float, Meta(gt=0.0, le=1e12)]
"""In bit/s."""
Bytes = Annotated[int, Meta(ge=0, le=65_535)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Edited = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""What somebody on the path writes into a packet, adds or multiplies with."""
Operation: TypeAlias = Literal["set", "add", "multiply"]
"""What is done to a number."""
Shape = Annotated[float, Meta(gt=0.0, le=1e6)]
Level = Annotated[int, Meta(ge=-32_768, le=32_767)]
"""Of a table of delays, in 1/8192 standard deviations."""
