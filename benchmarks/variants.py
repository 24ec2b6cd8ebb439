"""Numbers that carry variants of themselves through a computation.

A program runs once with a number's usual value. Each result also has the value that it would have
with each variant, such as half of the number. Where a comparison, or a use that cannot be followed,
has another outcome with a variant, that variant is noted: the program would continue differently. A
variant that is never noted provably gives the same results, so it needs no run of its own.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

FOLLOWED_METHODS = ("all", "any", "max", "mean", "min", "sum")
FOLLOWED_FUNCTIONS = (np.all, np.any, np.clip, np.max, np.mean, np.min, np.sum, np.where)
"""What is followed through arrays, beside arithmetic and comparisons."""


class WithVariants:
    """A number or an array with its variants.

    Attributes:
        value: the usual value, with which the program runs.
        variants: name of a variant -> its value.
        noted: receives the name of each variant with which the program would continue differently.
    """

    __slots__ = ("noted", "value", "variants")

    def __init__(self, value: Any, variants: Mapping[Any, Any], noted: set[Any]) -> None:
        self.value = value
        self.variants = variants
        self.noted = noted

    def _leave(self, form: Callable[[Any], Any]) -> Any:
        """A plain value, where the computation can no longer be followed."""
        usual = form(self.value)
        self.noted.update(n for n, v in self.variants.items() if not _equal(form(v), usual))
        return usual

    def __bool__(self) -> bool:
        return self._leave(bool)

    def __float__(self) -> float:
        return self._leave(float)

    def __int__(self) -> int:
        return self._leave(int)

    def __index__(self) -> int:
        return self._leave(operator.index)

    def __hash__(self) -> int:
        return self._leave(hash)

    def __format__(self, form: str) -> str:
        return self._leave(lambda v: format(v, form))

    def __str__(self) -> str:
        return self._leave(str)

    __repr__ = __str__

    def __round__(self, digits: int | None = None) -> Any:
        return _applied(round, (self,) if digits is None else (self, digits))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return self._leave(lambda v: np.array(v, dtype=dtype))

    def __len__(self) -> int:
        return self._leave(len)

    def __iter__(self) -> Iterator[Any]:
        return iter([self[i] for i in range(len(self))])

    def __getitem__(self, key: Any) -> Any:
        return _applied(operator.getitem, (self, key))

    def __setitem__(self, key: Any, value: Any) -> None:
        self.noted.update(self.variants)
        self.value[key] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in FOLLOWED_METHODS:
            return lambda *args, **options: _applied(
                lambda v, *rest, **named: getattr(v, name)(*rest, **named), (self, *args), options
            )
        return getattr(self._leave(lambda v: v), name)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *args: Any, **options: Any) -> Any:
        return _applied(getattr(ufunc, method), args, options)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        if function in FOLLOWED_FUNCTIONS:
            return _applied(function, args, options)
        for one in _inside([*args, *options.values()]):
            if isinstance(one, WithVariants):
                one.noted.update(one.variants)
        return function(*_at(args, None), **{k: _at(v, None) for k, v in options.items()})


def _operation(function: Callable[..., Any], *, swapped: bool) -> Callable[[Any, Any], Any]:
    def of_both(mine: WithVariants, other: Any) -> Any:
        if isinstance(other, np.ndarray | np.generic):
            # numpy then asks __array_ufunc__.
            return NotImplemented
        return _applied(function, (other, mine) if swapped else (mine, other))

    return of_both


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow"):
    _function = getattr(operator, _name)
    setattr(WithVariants, f"__{_name}__", _operation(_function, swapped=False))
    setattr(WithVariants, f"__r{_name}__", _operation(_function, swapped=True))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(WithVariants, f"__{_name}__", _operation(getattr(operator, _name), swapped=False))
for _function in (operator.neg, operator.pos, operator.abs):
    setattr(
        WithVariants,
        f"__{_function.__name__}__",
        functools.partialmethod(lambda mine, of: _applied(of, (mine,)), _function),
    )


def _applied(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    options: Mapping[str, Any] | None = None,
) -> Any:
    """Result of a pure function of numbers with variants, at the usual values and at each variant.

    The result is plain if all variants agree. Variants that disagree about a truth, or about a
    result that is no number, are noted. So are all of a function that writes into an array.
    """
    options = {} if options is None else options
    tracked = [a for a in _inside([*args, *options.values()]) if isinstance(a, WithVariants)]
    noted = tracked[0].noted
    names = {name for one in tracked for name in one.variants}

    def at(name: Any) -> Any:
        return function(*_at(args, name), **{k: _at(v, name) for k, v in options.items()})

    if options.get("out") is not None:
        noted.update(names)
        return at(None)
    usual = at(None)
    others = {}
    for name in names:
        try:
            other = at(name)
        except (ArithmeticError, ValueError, IndexError):
            noted.add(name)
            continue
        if not _equal(other, usual):
            others[name] = other
    if not others:
        return usual
    if isinstance(usual, int | float | np.number | np.ndarray) and not _is_truth(usual):
        return WithVariants(usual, others, noted)
    noted.update(others)
    return usual


def _is_truth(one: Any) -> bool:
    return isinstance(one, bool | np.bool_) or (isinstance(one, np.ndarray) and one.dtype == bool)


def _inside(args: Any) -> Iterator[Any]:
    for one in args:
        if isinstance(one, list | tuple):
            yield from _inside(one)
        else:
            yield one


def _at(one: Any, name: Any) -> Any:
    """Arguments with the usual values (``name`` None), or with those of a variant."""
    if isinstance(one, WithVariants):
        return one.value if name is None else one.variants.get(name, one.value)
    if type(one) in (list, tuple):
        return type(one)(_at(part, name) for part in one)
    return one


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        one, other = np.asarray(one), np.asarray(other)
        if one.dtype.kind in "fc" and other.dtype.kind in "fc":
            return np.array_equal(one, other, equal_nan=True)
        return np.array_equal(one, other)
    return bool(one == other) or (one != one and other != other)
