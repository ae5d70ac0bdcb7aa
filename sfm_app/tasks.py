"""Work that may be done on another machine: a function that can be named, and large values that it needs."""

from functools import partial
from typing import Generic, TypeVar

Value = TypeVar("Value")
Result = TypeVar("Result")


class Task(partial[Result]):
    """A function with some of its arguments that any worker can apply, on this machine or on another.

    Function, arguments and result are pickled where the worker is another process: the function stands in a module,
    what it needs besides is small, `Shared`, or in the output folder, and what it gives is returned or written there.
    In threads nothing is pickled. A function that is no task stays in the process that the user started.
    """


class Shared(Generic[Value]):
    """A large value that many calls need; it leaves the process once, as a file in the output folder, if at all.

    Args:
        value: read only.
    """

    __slots__ = ("value",)

    def __init__(self, value: Value) -> None:
        self.value = value
