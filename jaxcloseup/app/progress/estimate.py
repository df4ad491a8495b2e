"""The time that is left of a run: from its plan, and from how fast it went so far."""

import time
from collections.abc import Callable, Mapping


_COMPILES = 0.1  # share of a count's time, from which on compiling spoils its rate


class Estimate:
    """How far a run has come, and how long it still takes.

    The plan says how long parts take relative to each other. A part that counts its steps is
    measured by these alone. Time that goes to compiling says nothing about what is to come, and
    does not count.

    Attributes:
      name: of the current part; None between parts.
      done: steps of the current part, or None where it counts none.
      total: how many there will be.
    """

    def __init__(
        self,
        plan: Mapping[str, float],
        *,
        clock: Callable[[], float] = time.monotonic,
        compiled: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Begin with no part.

        Args:
          plan: typical seconds of each part by its name, in order.
          clock: seconds now.
          compiled: seconds that went to compiling so far.
        """
        self._plan, self._names = dict(plan), list(plan)
        self._clock, self._compiled = clock, compiled
        self._next = 0  # place of the first part that has not begun
        self._spent = self._typical = 0.0  # seconds of finished parts, and by the plan
        self.name: str | None = None
        self.done: int | None = None
        self.total = 0
        self._rate: float | None = None

    def begin(self, name: str) -> None:
        """Begin a part; those before it in the plan are over."""
        self.name, self.done, self._rate = name, None, None
        self._started, self._before, self._share = self._clock(), self._compiled(), 1.0
        if name in self._plan:
            self._next = self._names.index(name) + 1

    def end(self) -> None:
        """End the current part."""
        self._spent += self._cost()
        self._typical += self._share * self._plan.get(self.name, 0.0)
        self.name = self.done = None

    def skip(self, *names: str) -> None:
        """Take parts that will not come out of the plan."""
        for name in names:
            if name in self._names[self._next :]:
                self._names.remove(name)

    def count(self, done: int, total: int) -> None:
        """Count steps of the current part; the first call says with how many it begins."""
        now, compiled = self._clock(), self._compiled()
        if self.done is None:
            self._since, self._first = (done, now, compiled), done
            self._share = 1 - done / max(total, 1)
        else:
            first, since, before = self._since
            seconds, compiling = now - since, compiled - before
            self._rate = (done - first) / max(seconds - compiling, 0.01 * seconds, 1e-9)
            if compiling > _COMPILES * seconds:
                self._since = done, now, compiled
        self.done, self.total, self._counted = done, total, now

    @property
    def rate(self) -> float | None:
        """Steps of the current part in a second without compiling, once it is known."""
        return self._rate if self.name is not None else None

    def _worked(self):
        """How long the current part has taken, without compiling."""
        return max(self._clock() - self._started - (self._compiled() - self._before), 0.0)

    def _cost(self):
        """Seconds of all steps of the current part; without steps, those that it has taken."""
        if self._rate:
            return (self.total - self._first) / self._rate
        return self._worked()

    @property
    def place(self) -> tuple[int, int] | None:
        """Number of the current part in the plan, from 1, and how many there are."""
        return (self._next, len(self._names)) if self.name in self._plan else None

    def left(self) -> float | None:
        """Seconds until the last part ends, or, without a plan, the current one.

        None while nothing tells how fast this run goes.
        """
        spent, typical = self._spent, self._typical
        own = 0.0
        if self.name is not None:
            expected = self._share * self._plan.get(self.name, 0.0)
            if self._rate:
                own = (self.total - self.done) / self._rate
                own = max(own - (self._clock() - self._counted), 0.0)
                spent, typical = spent + self._cost(), typical + expected
            elif typical > 0:
                own = max(spent / typical * expected - self._worked(), 0.0)
        later = sum(self._plan[name] for name in self._names[self._next :])
        if not typical:
            return own if self._rate and not later else None
        return own + later * spent / typical
