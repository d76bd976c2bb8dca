"""Two practice clips before the first real one: nothing is stored but that they were done."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True, slots=True)
class Exercise:
    """One practice clip."""

    example: str
    """Which of the examples (``app/services/demo_images.py``)."""
    right: tuple[int, ...]
    """What people would give."""
    why: str
    """One sentence."""


EXERCISES = (
    Exercise(
        example="same",
        right=(5, 4),
        why="Both sides show the same moment, so you could take one for the other.",
    ),
    Exercise(
        example="far",
        right=(1, 2),
        why="Pose, direction and pace all differ. At first most of what the robot does is like this.",
    ),
)


@dataclass
class Lesson:
    """Somebody's way through the practice clips."""

    index: int = 0
    answer: int | None = None
    """What was given to the exercise on screen, None before that."""
    exercises: tuple[Exercise, ...] = field(default=EXERCISES)

    @property
    def over(self) -> bool:
        """Whether all of them are done."""
        return self.index >= len(self.exercises)

    @property
    def exercise(self) -> Exercise:
        """The one on screen."""
        return self.exercises[self.index]

    def begin(self) -> None:
        """From the first one on, (again)."""
        self.index, self.answer = 0, None

    def leave(self) -> None:
        """Does without the rest."""
        self.index, self.answer = len(self.exercises), None

    def take(self, exercise: int, do: int | str) -> bool:
        """One press.

        Args:
            exercise: Index of the one that was on screen.
            do: A rating; "next", once there is one; "leave" does without the rest.

        Returns:
            False if it counts for nothing.
        """
        if self.over or exercise != self.index:
            return False
        if do == "leave":
            self.leave()
        elif do == "next" and self.answer is not None:
            self.index, self.answer = self.index + 1, None
        elif isinstance(do, int) and self.answer is None:
            self.answer = do
        else:
            return False
        return True

    @property
    def feedback(self) -> str:
        """What to say of the answer, two sentences."""
        assert self.answer is not None
        wanted = " or ".join(str(value) for value in self.exercise.right)
        if self.answer in self.exercise.right:
            return f"{self.answer} is right. {self.exercise.why}"
        return f"You gave {self.answer}; most people would give {wanted}. {self.exercise.why}"
