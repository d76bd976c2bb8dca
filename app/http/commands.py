"""What researchers do with a press of a button, beyond watching: each action with the fields it takes."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from onedemo.app.http import invitations
from onedemo.app.services import demo_shelf
from onedemo.app.services.run_manager import OFFERED
from onedemo.app.templates import render
from onedemo.errors import UserError
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

    def do(self, who: Rater, body: Any, address: str = "") -> Markup | None:
        """Does what a browser asks for: ``{"do": name, ...}``; what it answers is for whoever asked alone.

        Args:
            who: Asks; a researcher.
            body: As JSON gave it.
            address: That links begin with.

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
        about_people = {"revoke": self._revoke, "revoke link": self._revoke_link}  # they write their own line
        name, fields = body["do"], {key: value for key, value in body.items() if key != "do"}
        if name == "invite":
            return self._invite(who, fields, address)
        if name in about_people:
            about_people[name](who, fields)
        elif name in actions:
            actions[name](who, fields)
            detail = ", ".join(f"{key} {value}" for key, value in fields.items() if value != "")
            self._store.audit.add(who.name, name, f"{detail}; run {self._page.trainer.run}")
        else:
            raise ValueError(f"there is no action {name[:40]!r}")
        return None

    def _invite(self, who: Rater, fields: dict[str, Any], address: str) -> Markup:
        kinds = {"role": str, "expires": str, "once": bool, "address": str}
        names = fields.pop("names", None)
        if not isinstance(names, str):
            raise ValueError(f"the action takes names, {', '.join(kinds)}")
        _check(fields, kinds, longest=200)
        if fields["role"] not in ("annotator", "researcher"):
            raise ValueError("people are invited as annotator or researcher")
        if fields["address"]:
            address = invitations.check_address(fields["address"])
        made = invitations.invite(
            self._store, [name for name in names.splitlines() if name.strip()], fields["role"], address,
            by=who.name, once=fields["once"], expires=fields["expires"] or None,
        )  # fmt: skip
        return render(
            "start.html:invited", invitations=made, once=fields["once"], local=invitations.local(address)
        )

    def _revoke(self, who: Rater, fields: dict[str, Any]) -> None:
        sure = fields.pop("sure", False)
        rater = self._rater(fields)
        self._not_oneself(who, rater, sure)
        invitations.revoke(self._store, rater, by=who.name)

    def _revoke_link(self, who: Rater, fields: dict[str, Any]) -> None:
        sure = fields.pop("sure", False)
        _check(fields, {"link": int})
        link = next((link for link in self._store.accounts.links() if link.id == fields["link"]), None)
        if link is None:
            raise ValueError(f"there is no link {fields['link']}")
        self._not_oneself(who, link.rater, sure)
        invitations.revoke_link(self._store, link.id, by=who.name)

    def _not_oneself(self, who: Rater, rater: Rater, sure: Any) -> None:
        if rater.id == who.id and sure is not True:
            raise UserError("that would close your own page; say that you are sure")

    def _exclude(self, who: Rater, fields: dict[str, Any]) -> None:
        self._store.ratings.leave_out(self._page.trainer.run, self._rater(fields).id, by=who.id)

    def _include(self, who: Rater, fields: dict[str, Any]) -> None:
        rater = self._rater(fields).id
        self._store.ratings.leave_out(self._page.trainer.run, rater, by=who.id, left_out=False)

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

    def _rater(self, fields: dict[str, Any]) -> Rater:
        _check(fields, {"rater": int})
        known = {rater.id: rater for rater in self._store.accounts.raters()}
        if fields["rater"] not in known:
            raise ValueError(f"there is no rater {fields['rater']}")
        return known[fields["rater"]]


def _check(fields: dict[str, Any], kinds: dict[str, type], longest: int = 100) -> None:
    if set(fields) != set(kinds) or any(type(fields[name]) is not kind for name, kind in kinds.items()):
        raise ValueError(f"the action takes {', '.join(kinds) or 'no fields'}")
    for name, value in fields.items():
        if isinstance(value, str) and not (len(value) <= longest and (value == "" or value.isprintable())):
            raise ValueError(f"{name} is up to {longest} printable characters")
