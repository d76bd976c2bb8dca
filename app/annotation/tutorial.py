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

    def give(self, value: int) -> bool:
        """Answers the exercise on screen; False if it has been."""
        if self.answer is not None:
            return False
        self.answer = value
        return True

    def go_on(self) -> bool:
        """To the next one, once this one is answered."""
        if self.answer is None:
            return False
        self.index, self.answer = self.index + 1, None
        return True

    def leave(self) -> bool:
        """Does without the rest."""
        self.index, self.answer = len(self.exercises), None
        return True

    @property
    def feedback(self) -> str:
        """What to say of the answer, two sentences."""
        assert self.answer is not None
        wanted = " or ".join(str(value) for value in self.exercise.right)
        if self.answer in self.exercise.right:
            return f"{self.answer} is right. {self.exercise.why}"
        return f"You gave {self.answer}; most people would give {wanted}. {self.exercise.why}"
