"""Estimate the time left of a run, from its plan and from its speed so far."""

from collections.abc import Callable, Mapping


class Estimate:
    """How far a run has come, and how long it still takes.

    The plan says how long parts take relative to each other; finished parts, and the steps of the
    current one, say how long they take on this computer. The thread that draws the line reads an
    estimate while it changes.

    Attributes:
      name: name of the current part; None between parts.
      done: steps of the current part, or None if it counts none.
      total: how many steps the current part has.
      rate: steps per second of the current part, or None before two counts.
    """

    def __init__(self, plan: Mapping[str, float], clock: Callable[[], float]) -> None:
        """Begin with no part.

        Args:
          plan: typical seconds of each part by its name, in order.
          clock: returns seconds of work so far. It stands still while XLA compiles, which says
            nothing about the time left.
        """
        self._plan, self._names, self._clock = dict(plan), list(plan), clock
        self._begun = 0  # parts of the plan that have begun or were left out
        self._spent = self._typical = 0.0  # seconds of finished parts: as measured, by the plan
        self._started = self._counted = 0.0
        self._first = self.total = 0
        self.name: str | None = None
        self.done: int | None = None
        self.rate: float | None = None

    def begin(self, name: str) -> None:
        """Begin a part; earlier parts of the plan are over."""
        self.name, self.done, self.rate, self._started = name, None, None, self._clock()
        if name in self._plan:
            self._begun = self._names.index(name) + 1

    def end(self) -> None:
        """End the current part."""
        spent, typical = self._cost()
        self._spent, self._typical = self._spent + spent, self._typical + typical
        self.name = self.done = self.rate = None

    def count(self, done: int, total: int) -> None:
        """Count the steps of the current part; the first call sets where it begins."""
        now = self._clock()
        if self.done is None:
            self._first = done
        elif now > self._counted:
            self.rate = (done - self.done) / (now - self._counted)
        self.done, self.total, self._counted = done, total, now

    @property
    def place(self) -> tuple[int, int] | None:
        """Return the number of the current part in the plan, from 1, and the number of parts."""
        return (self._begun, len(self._names)) if self.name in self._plan else None

    def left(self) -> float | None:
        """Return the seconds until the last part ends, or, without a plan, the current one.

        None before anything was measured.
        """
        spent, typical, current = self._spent, self._typical, 0.0
        done, rate = self.done, self.rate
        if self.name is not None:
            cost, expected = self._cost()
            if rate and done is not None:
                current = (self.total - done) / rate - (self._clock() - self._counted)
                spent, typical = spent + cost, typical + expected
            elif typical:
                current = spent / typical * expected - cost
        later = sum(self._plan[name] for name in self._names[self._begun :])
        if typical:
            return max(current, 0.0) + later * spent / typical
        return max(current, 0.0) if rate and not later else None

    def _cost(self) -> tuple[float, float]:
        """Return the seconds of the current part: as measured, and by the plan.

        A part that counts steps is measured by its rate. A resumed one takes only a share.
        """
        typical, rate = self._plan.get(self.name or "", 0.0), self.rate
        if self.done is not None:
            typical *= 1 - self._first / max(self.total, 1)
        if rate:
            return (self.total - self._first) / rate, typical
        return max(self._clock() - self._started, 0.0), typical
