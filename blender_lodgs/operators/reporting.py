"""How operators tell users what went wrong."""

from __future__ import annotations

import functools

from ...training.errors import LodgsError


def saying_errors(execute):
    """Wraps an operator's execute: a LodgsError becomes a report of its sentences, and it cancels."""

    @functools.wraps(execute)
    def said(self, context):
        try:
            return execute(self, context)
        except LodgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    return said
