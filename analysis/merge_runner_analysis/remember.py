"""Results that are computed once per study, or per group of trials, and freed together with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

Owner = TypeVar("Owner")
Others = ParamSpec("Others")
Result = TypeVar("Result")


def remembered(
    function: Callable[Concatenate[Owner, Others], Result],
) -> Callable[Concatenate[Owner, Others], Result]:
    """Keep a function's results in its first argument, by the other ones.

    A cache of the module would keep every study that was ever read.
    """

    @wraps(function)
    def remember(owner: Owner, /, *args: Others.args, **kwargs: Others.kwargs) -> Result:
        results: dict[Any, Result] = vars(owner).setdefault("_remembered", {})
        key = (function, args, *kwargs.items())
        if key not in results:
            results[key] = function(owner, *args, **kwargs)
        return results[key]

    return remember
