"""What researchers do with a press of a button, beyond watching: each action with the fields it takes."""

from __future__ import annotations

from typing import Any

from onedemo.app.services import demo_shelf
from onedemo.app.services.run_manager import OFFERED
from onedemo.storage.rating_records import MOST_REASON
from onedemo.storage.store import Store
from onedemo.types import Rater


class Actions:
    """Carries out actions of researchers.

    Args:
        page: What is served: its ``trainer`` is the run at hand, its ``study`` all runs.
    """

    def __init__(self, page: Any) -> None:
        self._page = page

    def do(self, who: Rater, body: Any) -> None:
        """Does what a browser asks for: ``{"do": name, ...}``.

        Args:
            who: Asks; a researcher.
            body: As JSON gave it.

        Raises:
            ValueError: If it is no action, or its fields are not what it takes.
            UserError: If it cannot be done.
        """
        if not isinstance(body, dict) or not isinstance(body.get("do"), str):
            raise ValueError("an action has a name")
        actions = {
            "exclude": self._exclude, "include": self._include, "open run": self._open,
            "new run": self._create, "pause run": self._pause, "resume run": self._resume,
            "withdraw": self._withdraw, "describe run": self._describe, "delete run": self._delete,
            "rename demo": self._rename_demo, "remove demo": self._remove_demo,
        }  # fmt: skip
        if body["do"] not in actions:
            raise ValueError(f"there is no action {body['do'][:40]!r}")
        fields = {key: value for key, value in body.items() if key != "do"}
        actions[body["do"]](who, fields)
        detail = ", ".join(f"{key} {value}" for key, value in fields.items() if value != "")
        self._store.audit.add(who.name, body["do"], f"{detail}; run {self._page.trainer.run}")

    def _exclude(self, who: Rater, fields: dict[str, Any]) -> None:
        self._store.ratings.leave_out(self._page.trainer.run, self._rater(fields), by=who.id)

    def _include(self, who: Rater, fields: dict[str, Any]) -> None:
        self._store.ratings.leave_out(self._page.trainer.run, self._rater(fields), by=who.id, left_out=False)

    def _withdraw(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"rating": int, "reason": str}, longest=MOST_REASON)
        self._store.ratings.withdraw(fields["rating"], fields["reason"], by=who.id)

    def _open(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"run": str})
        self._study.open(fields["run"])

    def _pause(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {})
        self._page.trainer.pause()

    def _resume(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {})
        self._page.trainer.resume()

    def _create(self, who: Rater, fields: dict[str, Any]) -> None:
        # What is left empty is as usual.
        given = {key: fields.pop(key) for key in OFFERED if key in fields}
        settings = {key: value for key, value in given.items() if value not in (None, "")}
        if not all(isinstance(v, (int, float, str)) and len(str(v)) <= 40 for v in settings.values()):
            raise ValueError("a setting is a number or a word")
        _check(fields, {"demo": str, "method": str, "seed": int, "name": str, "predictor_from": str})
        texts = {name: fields[name].strip() or None for name in ("name", "predictor_from")}
        self._study.create(
            demo=fields["demo"], method=fields["method"], seed=fields["seed"], settings=settings, **texts
        )
        fields |= settings

    def _describe(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"run": str, "title": str, "note": str}, longest=500)
        title, note = fields["title"].strip(), fields["note"].strip()
        self._study.describe(fields["run"], title=title, note=note)

    def _delete(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"run": str})
        self._study.delete(fields["run"])

    def _rename_demo(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"demo": str, "name": str})
        demo_shelf.rename(self._store, self._store.path.parent, fields["demo"], fields["name"].strip())

    def _remove_demo(self, who: Rater, fields: dict[str, Any]) -> None:
        _check(fields, {"demo": str})
        demo_shelf.remove(self._store, self._store.path.parent, fields["demo"])

    @property
    def _store(self) -> Store:
        return self._page.trainer.store

    @property
    def _study(self) -> Any:
        if self._page.study is None:
            raise ValueError("there is this run alone")
        return self._page.study

    def _rater(self, fields: dict[str, Any]) -> int:
        _check(fields, {"rater": int})
        if fields["rater"] not in {rater.id for rater in self._store.accounts.raters()}:
            raise ValueError(f"there is no rater {fields['rater']}")
        return fields["rater"]


def _check(fields: dict[str, Any], kinds: dict[str, type], longest: int = 100) -> None:
    if set(fields) != set(kinds) or any(type(fields[name]) is not kind for name, kind in kinds.items()):
        raise ValueError(f"the action takes {', '.join(kinds) or 'no fields'}")
    for name, value in fields.items():
        if isinstance(value, str) and not (len(value) <= longest and (value == "" or value.isprintable())):
            raise ValueError(f"{name} is up to {longest} printable characters")
