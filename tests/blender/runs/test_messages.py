"""Texts of durations."""

import pytest


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (89, "89 s"), (150, "2 min"), (3600, "1 h 00 min"), (7500, "2 h 05 min")],
)
def test_duration_format(lodgs, seconds, text):
    assert lodgs("training.evaluate.messages").format_duration(seconds) == text
