"""What comes before somebody's first clip: three lines and the whole video, then practice clips.

Nothing is stored but that it was done.
"""

from __future__ import annotations

from collections.abc import Callable

from onedemo.app.annotation.examples import Example


class Lesson:
    """Somebody's way through introduction and practice.

    Args:
        offered: Gives the practice clips, as they are known by then.
    """

    def __init__(self, offered: Callable[[], tuple[Example, ...]]) -> None:
        self._offered = offered
        self.begin(introduce=True)

    def begin(self, *, introduce: bool = False) -> None:
        """From the first practice clip on (again), or from the introduction."""
        self.exercises = self._offered()
        self.index = 0 if introduce else 1
        """What is on screen: 0 is the introduction, n the n-th practice clip."""
        self.answer: int | None = None
        """What was given to the practice clip on screen, None before that."""

    @property
    def over(self) -> bool:
        """Whether all of it is done."""
        return self.index > len(self.exercises)

    @property
    def introducing(self) -> bool:
        """Whether the introduction is on screen."""
        return self.index == 0

    @property
    def exercise(self) -> Example:
        """The practice clip on screen."""
        return self.exercises[self.index - 1]

    def leave(self) -> None:
        """Does without the rest."""
        self.index, self.answer = len(self.exercises) + 1, None

    def take(self, exercise: int, do: int | str) -> bool:
        """One press.

        Args:
            exercise: What was on screen, as ``index``.
            do: A rating; "next", once there is one; "leave" does without the rest.

        Returns:
            False if it counts for nothing.
        """
        if self.over or exercise != self.index:
            return False
        if do == "leave":
            self.leave()
        elif do == "next" and self.introducing:
            self.begin()
        elif do == "next" and self.answer is not None:
            self.index, self.answer = self.index + 1, None
        elif isinstance(do, int) and self.answer is None and not self.introducing:
            self.answer = do
        else:
            return False
        return True

    @property
    def feedback(self) -> str:
        """What to say of the answer, two or three sentences."""
        example, given = self.exercise, self.answer
        if given == example.rating:
            return f"{given} is what most people would give. {example.why}"
        if given in example.right_ratings:
            return f"{given} is near enough; most people would give {example.rating}. {example.why}"
        return f"You gave {given}; most people would give {example.rating}. {example.why}"
