"""Tasks that another machine can do: a named function, and large values for it."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")
Result = TypeVar("Result")

ParallelMap = Callable[[Callable[[Any], Any], Sequence[Any], str], list[Any]]
"""Applies a function to all items, possibly in parallel, and returns results in order; the label names the progress."""
Spread = Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]]
"""Calls a function for every number, possibly in parallel, and returns the results in order."""


class Task(partial[Result]):
    """A function with some of its arguments that any worker can apply, on this machine or on another.

    A worker in another process needs pickles: the function is part of a module; its arguments are small, `Shared`, or
    files in the output folder; its result is returned or written there. Threads need no pickles. Other functions stay
    in the process of the run.
    """


class Shared(Generic[Value]):
    """A large read-only value of many calls; it leaves the process at most once, as a file in the output folder."""

    __slots__ = ("value",)

    def __init__(self, value: Value) -> None:
        self.value = value
