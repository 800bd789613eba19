"""Tables of refusals: what cannot be made, and the sentence that says so."""

import re
from collections.abc import Callable, Iterable
from typing import Any

import pytest

Refusal = tuple[str, Callable[[], Any]]  # pattern of the message, and what is refused


def check_refused(rows: Iterable[Refusal], *, remedy: bool = True) -> None:
    """Each is a `ValueError` with this message, and with a remedy in a sentence of its own."""
    for message, make in rows:
        with pytest.raises(ValueError, match=message) as told:
            make()
        is_told = re.search(r"[.;] [A-Z]", str(told.value))
        assert is_told or not remedy, f"no remedy: {told.value}"
