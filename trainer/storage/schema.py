"""The database schema: the first release's, then one step per version. A step, once released, stays.

``PRAGMA user_version`` holds the number of the last step a database has seen; 0 is an empty one. Numbers 1
to 4 were used before the first release; databases of those are refused.
"""

from __future__ import annotations

import re
import sqlite3

STEPS: dict[int, str] = {
    5: """
    -- People, and their links and sessions.
    CREATE TABLE raters (
        id INTEGER PRIMARY KEY,
        name TEXT NOT NULL UNIQUE,
        role TEXT NOT NULL CHECK (role IN ('annotator', 'researcher', 'simulated')),
        created_at TEXT NOT NULL,
        practised_at TEXT               -- when the practice clips were done
    );
    -- A link (in a URL) or a session (in a cookie).
    CREATE TABLE tokens (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        hash TEXT NOT NULL UNIQUE,      -- SHA-256 of the token, never the token
        rater_id INTEGER NOT NULL REFERENCES raters (id),
        kind TEXT NOT NULL CHECK (kind IN ('link', 'session')),
        link_id INTEGER REFERENCES tokens (id),  -- of a session: the link it came by, if that is known
        once INTEGER NOT NULL DEFAULT 0 CHECK (once IN (0, 1)),  -- of a link: it opens once
        created_at TEXT NOT NULL,
        expires_at TEXT,                -- none: it does not
        last_used_at TEXT,
        revoked_at TEXT
    );
    CREATE INDEX tokens_by_rater ON tokens (rater_id, kind);
    -- Runs, and what training recorded for each.
    CREATE TABLE runs (
        id TEXT PRIMARY KEY,
        demo TEXT NOT NULL,
        demo_sha256 TEXT NOT NULL,
        seed INTEGER NOT NULL,
        config TEXT NOT NULL,           -- TOML, resolved
        version TEXT NOT NULL,
        created_at TEXT NOT NULL,
        clips INTEGER NOT NULL DEFAULT 0  -- ever cut
    );
    CREATE TABLE snapshots (
        run TEXT NOT NULL REFERENCES runs (id),
        number INTEGER NOT NULL,
        last_event INTEGER NOT NULL,    -- it was fitted on the ratings that held at this event
        ratings INTEGER NOT NULL,
        stats TEXT NOT NULL,            -- JSON
        created_at TEXT NOT NULL,
        PRIMARY KEY (run, number)
    );
    CREATE TABLE iterations (
        run TEXT NOT NULL REFERENCES runs (id),
        number INTEGER NOT NULL,
        snapshot INTEGER NOT NULL,      -- that scored the whole iteration
        env_steps INTEGER NOT NULL,     -- control steps so far
        stats TEXT NOT NULL,            -- JSON
        created_at TEXT NOT NULL,
        PRIMARY KEY (run, number)
    );
    -- Clips, with the segment behind each.
    CREATE TABLE clips (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        run TEXT NOT NULL REFERENCES runs (id),
        demo_step INTEGER NOT NULL,     -- control step of the demo at which the clip begins
        steps INTEGER NOT NULL,         -- length in control steps
        stage TEXT NOT NULL CHECK (stage IN ('pretrain', 'online')),
        iteration INTEGER NOT NULL,     -- whose rollouts it was cut from
        snapshot INTEGER NOT NULL,      -- that made the prediction; 0: none
        predicted REAL,                 -- 1..5
        state TEXT NOT NULL DEFAULT 'cut' CHECK (state IN ('cut', 'ready', 'withdrawn')),
        created_at TEXT NOT NULL,
        answers INTEGER NOT NULL DEFAULT 0,  -- ratings and skips of it that hold
        choice TEXT NOT NULL DEFAULT '',  -- why it is asked; trainer/queries/selection.py
        score REAL                      -- by what it was chosen
    );
    CREATE INDEX clips_waiting ON clips (run, state, id) WHERE answers = 0;
    CREATE TRIGGER clips_count AFTER INSERT ON clips BEGIN
        UPDATE runs SET clips = clips + 1 WHERE id = new.run;
    END;
    -- Observations, actions, qpos and qvel of the clip (trainer/storage/segment_codec.py). A rating is
    -- worthless without them.
    CREATE TABLE segments (
        clip_id INTEGER PRIMARY KEY REFERENCES clips (id),
        data BLOB NOT NULL
    );
    -- What raters did, append-only. The last event of a rater on a clip is the one that holds.
    CREATE TABLE events (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        clip_id INTEGER REFERENCES clips (id),  -- none: it is about the rater
        rater_id INTEGER NOT NULL REFERENCES raters (id),
        kind TEXT NOT NULL CHECK (kind IN ('rate', 'undo', 'skip', 'leave out', 'take in')),
        value INTEGER CHECK (value BETWEEN 1 AND 5),
        repeat INTEGER NOT NULL DEFAULT 0 CHECK (repeat IN (0, 1)),  -- 1: the rater's second opinion
        mark_start REAL,                -- where it goes wrong, seconds from the start of the clip
        mark_end REAL,
        reason TEXT,                    -- of a skip
        snapshot INTEGER NOT NULL,      -- newest prediction of the clip at that time
        predicted REAL,
        latency_ms INTEGER NOT NULL,    -- from the clip on screen to the press
        run TEXT REFERENCES runs (id),  -- in which a rater is left out or taken in again
        by_id INTEGER REFERENCES raters (id),  -- who did that
        created_at TEXT NOT NULL,
        CHECK ((kind = 'rate') = (value IS NOT NULL)),
        CHECK ((clip_id IS NULL) = (kind IN ('leave out', 'take in'))),
        CHECK ((clip_id IS NULL) = (run IS NOT NULL)),
        CHECK ((mark_start IS NULL) = (mark_end IS NULL)),
        CHECK (mark_start IS NULL OR (kind = 'rate' AND 0 <= mark_start AND mark_start < mark_end)),
        CHECK (reason IS NULL OR kind = 'skip')
    );
    CREATE INDEX events_by_clip ON events (clip_id, rater_id, repeat, id);
    CREATE INDEX events_about_raters ON events (run, rater_id, id) WHERE clip_id IS NULL;
    CREATE TRIGGER events_keep_update BEFORE UPDATE ON events
        BEGIN SELECT RAISE(ABORT, 'rating events are append-only'); END;
    CREATE TRIGGER events_keep_delete BEFORE DELETE ON events
        BEGIN SELECT RAISE(ABORT, 'rating events are append-only'); END;
    -- Ratings that hold, counted by triggers, so that what the page asks at every press does not grow with
    -- the events. The events stay the one truth: these counts can be worked out from them again.
    CREATE TABLE tallies (
        run TEXT NOT NULL REFERENCES runs (id),
        rater_id INTEGER NOT NULL REFERENCES raters (id),
        stage TEXT NOT NULL,
        value INTEGER NOT NULL,
        ratings INTEGER NOT NULL,
        PRIMARY KEY (run, rater_id, stage, value)
    ) WITHOUT ROWID;
    -- A new event takes the place of the rater's event before it on the same clip, whatever both are.
    -- Second opinions do not count.
    CREATE TRIGGER events_count AFTER INSERT ON events WHEN new.clip_id IS NOT NULL AND new.repeat = 0 BEGIN
        UPDATE tallies SET ratings = ratings - 1
            WHERE (run, stage) = (SELECT run, stage FROM clips WHERE id = new.clip_id)
            AND rater_id = new.rater_id AND value = (
                SELECT value FROM events
                WHERE clip_id = new.clip_id AND rater_id = new.rater_id AND repeat = 0 AND id < new.id
                ORDER BY id DESC LIMIT 1
            );
        INSERT INTO tallies
            SELECT run, new.rater_id, stage, new.value, 1 FROM clips
            WHERE id = new.clip_id AND new.kind = 'rate'
            ON CONFLICT DO UPDATE SET ratings = ratings + 1;
        UPDATE clips SET answers = answers + (new.kind != 'undo') - COALESCE((
                SELECT kind != 'undo' FROM events
                WHERE clip_id = new.clip_id AND rater_id = new.rater_id AND repeat = 0 AND id < new.id
                ORDER BY id DESC LIMIT 1
            ), 0)
            WHERE id = new.clip_id;
    END;
    -- What other programs read: the ratings that hold, one row each; second opinions have repeat 1.
    CREATE VIEW ratings AS
        SELECT e.id, e.clip_id, c.run, r.demo, p.name AS rater, e.value, c.stage, c.iteration,
               e.created_at, e.latency_ms, e.snapshot, e.predicted, c.demo_step, c.steps,
               e.repeat, e.mark_start, e.mark_end, c.choice, c.score,
               COALESCE((
                   SELECT o.kind = 'leave out' FROM events o
                   WHERE o.clip_id IS NULL AND o.run = c.run AND o.rater_id = e.rater_id
                   ORDER BY o.id DESC LIMIT 1
               ), 0) AS left_out
        FROM events e
        JOIN clips c ON c.id = e.clip_id
        JOIN runs r ON r.id = c.run
        JOIN raters p ON p.id = e.rater_id
        WHERE e.kind = 'rate' AND NOT EXISTS (
            SELECT 1 FROM events l
            WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id AND l.repeat = e.repeat AND l.id > e.id
        );
    -- Pairs of clips, and which of the two is nearer to the demo.
    CREATE TABLE pairs (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        run TEXT NOT NULL REFERENCES runs (id),
        demo_step INTEGER NOT NULL,     -- control step of the demo at which both clips begin
        steps INTEGER NOT NULL,         -- length in control steps
        stage TEXT NOT NULL CHECK (stage IN ('pretrain', 'online')),
        iteration INTEGER NOT NULL,     -- whose rollouts they were cut from
        left_segment BLOB NOT NULL,     -- as in segments
        right_segment BLOB NOT NULL,
        state TEXT NOT NULL DEFAULT 'cut' CHECK (state IN ('cut', 'ready', 'withdrawn')),
        created_at TEXT NOT NULL
    );
    CREATE INDEX pairs_by_run ON pairs (run, state, id);
    -- Append-only. The last answer of a rater on a pair is the one that holds.
    CREATE TABLE comparisons (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        pair_id INTEGER NOT NULL REFERENCES pairs (id),
        rater_id INTEGER NOT NULL REFERENCES raters (id),
        answer TEXT NOT NULL CHECK (answer IN ('left', 'right', 'equal', 'skip', 'undo')),
        latency_ms INTEGER NOT NULL,
        created_at TEXT NOT NULL
    );
    CREATE INDEX comparisons_by_pair ON comparisons (pair_id, rater_id, id);
    CREATE TRIGGER comparisons_keep_update BEFORE UPDATE ON comparisons
        BEGIN SELECT RAISE(ABORT, 'comparisons are append-only'); END;
    CREATE TRIGGER comparisons_keep_delete BEFORE DELETE ON comparisons
        BEGIN SELECT RAISE(ABORT, 'comparisons are append-only'); END;
    -- The answers that hold, one row each; skipped pairs are none.
    CREATE VIEW answers AS
        SELECT c.id, c.pair_id, p.run, r.demo, a.name AS rater, c.answer, p.stage, p.iteration, c.created_at,
               c.latency_ms, p.demo_step, p.steps
        FROM comparisons c
        JOIN pairs p ON p.id = c.pair_id
        JOIN runs r ON r.id = p.run
        JOIN raters a ON a.id = c.rater_id
        WHERE c.answer IN ('left', 'right', 'equal') AND NOT EXISTS (
            SELECT 1 FROM comparisons l
            WHERE l.pair_id = c.pair_id AND l.rater_id = c.rater_id AND l.id > c.id
        );
    -- Who signed in, and took or changed what.
    CREATE TABLE audit (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        at TEXT NOT NULL,
        who TEXT NOT NULL,              -- a rater, "command line", or the address of a stranger
        what TEXT NOT NULL,
        detail TEXT NOT NULL DEFAULT ''
    );
    CREATE TRIGGER audit_keep_update BEFORE UPDATE ON audit
        BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END;
    CREATE TRIGGER audit_keep_delete BEFORE DELETE ON audit
        BEGIN SELECT RAISE(ABORT, 'the audit log is append-only'); END;
    """,
    # 6: marks in control steps, worked out once from the seconds of earlier ratings (mark_start, mark_end:
    # they stay as they were written, and nothing writes or reads them any more); the view gives seconds as
    # before. What a rater said last is found by index, so that undo can ask for it.
    6: """
    ALTER TABLE runs ADD COLUMN step_seconds REAL NOT NULL DEFAULT 0.008;  -- of a control step
    ALTER TABLE events ADD COLUMN mark_from INTEGER CHECK (mark_from >= 0);  -- first marked step of the clip
    ALTER TABLE events ADD COLUMN mark_to INTEGER  -- the step after the last marked one
        CHECK ((mark_from IS NULL) = (mark_to IS NULL))
        CHECK (mark_from IS NULL OR (kind = 'rate' AND mark_from < mark_to));
    DROP TRIGGER events_keep_update;
    UPDATE events SET mark_from = first, mark_to = MIN(steps, MAX(first + 1, after)) FROM (
        SELECT id AS event, steps,  -- rounded as in Python, halves to the even number
               MIN(steps - 1, CAST(ROUND(f) AS INTEGER)
                   - (f % 2 = 0 AND f - CAST(f AS INTEGER) = 0.5)) AS first,
               CAST(ROUND(t) AS INTEGER) - (t % 2 = 0 AND t - CAST(t AS INTEGER) = 0.5) AS after
        FROM (SELECT e.id, c.steps, e.mark_start / 0.008 AS f, e.mark_end / 0.008 AS t
              FROM events e JOIN clips c ON c.id = e.clip_id WHERE e.mark_start IS NOT NULL)
    ) WHERE events.id = event;
    CREATE TRIGGER events_keep_update BEFORE UPDATE ON events
        BEGIN SELECT RAISE(ABORT, 'rating events are append-only'); END;
    CREATE INDEX events_by_rater ON events (rater_id, id);
    CREATE INDEX comparisons_by_rater ON comparisons (rater_id, id);
    DROP VIEW ratings;
    CREATE VIEW ratings AS
        SELECT e.id, e.clip_id, c.run, r.demo, p.name AS rater, e.value, c.stage, c.iteration,
               e.created_at, e.latency_ms, e.snapshot, e.predicted, c.demo_step, c.steps,
               e.repeat, ROUND(e.mark_from * r.step_seconds, 6) AS mark_start,
               ROUND(e.mark_to * r.step_seconds, 6) AS mark_end, c.choice, c.score,
               COALESCE((
                   SELECT o.kind = 'leave out' FROM events o
                   WHERE o.clip_id IS NULL AND o.run = c.run AND o.rater_id = e.rater_id
                   ORDER BY o.id DESC LIMIT 1
               ), 0) AS left_out
        FROM events e
        JOIN clips c ON c.id = e.clip_id
        JOIN runs r ON r.id = c.run
        JOIN raters p ON p.id = e.rater_id
        WHERE e.kind = 'rate' AND NOT EXISTS (
            SELECT 1 FROM events l
            WHERE l.clip_id = e.clip_id AND l.rater_id = e.rater_id AND l.repeat = e.repeat AND l.id > e.id
        );
    """,
    # 7: a rating that a researcher took back later is an undo with the reason; by_id says who it was.
    7: """
    ALTER TABLE events ADD COLUMN withdrawn TEXT CHECK (withdrawn IS NULL OR kind = 'undo');
    """,
    # 8: when a run was held and went on, for the charts.
    8: """
    CREATE TABLE run_marks (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        run TEXT NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
        iteration INTEGER NOT NULL,     -- the last one before it
        kind TEXT NOT NULL CHECK (kind IN ('paused', 'resumed', 'stopped', 'failed')),
        created_at TEXT NOT NULL
    );
    CREATE INDEX run_marks_by_run ON run_marks (run, id);
    """,
    # 9: what people call a run and say of it; its name (id) stays, as that of its directory and in exports.
    9: """
    ALTER TABLE runs ADD COLUMN title TEXT NOT NULL DEFAULT '';
    ALTER TABLE runs ADD COLUMN note TEXT NOT NULL DEFAULT '';
    """,
    # 10: why a pair was skipped, in the rater's words.
    10: """
    ALTER TABLE comparisons ADD COLUMN reason TEXT CHECK (reason IS NULL OR answer = 'skip');
    """,
}


_TOKEN = re.compile(r"""('(?:[^']|'')*')|--[^\n]*|"(\w+)"|(\w+|[^\w\s])""", re.ASCII)
"""A text, which counts to the letter; a comment, which does not; a quoted name; a word or a sign."""


def check_version(connection: sqlite3.Connection) -> int:
    """The schema version of a database; reads only.

    Raises:
        ValueError: If the database was made by a newer program or before the first release. It says so and
            what to do, to be put behind "the database was".
    """
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > max(STEPS):
        raise ValueError(
            f"written by a newer onedemo (schema version {version}, this one reads up to {max(STEPS)}); "
            "update onedemo to open it"
        )
    if 0 < version < min(STEPS):
        raise ValueError(
            f"written before onedemo 0.1.0 (schema version {version}, this one reads {min(STEPS)} to "
            f"{max(STEPS)}); open it with the onedemo that wrote it, or choose another --data-dir"
        )
    return version


def check_schema(connection: sqlite3.Connection) -> int:
    """The version of a database whose tables, views and triggers are ours to the letter; reads no other.

    Call it before anything else is asked of a database that may be somebody else's: a view may run for
    ever, and a trigger or a computed column do what nobody wants.

    Raises:
        ValueError: As ``check_version``; or something is missing, different, or more than there should be.
    """
    version = check_version(connection)
    if version == 0:
        raise ValueError("not written by onedemo")
    wanted, there = _objects(_made(version)), _objects(connection)
    for key in sorted({*wanted, *there}, key=str):
        if wanted.get(key) != there.get(key):
            kind, name = key
            how = "added" if key not in wanted else "removed" if key not in there else "changed"
            raise ValueError(f"changed by another program: {kind} {ascii(str(name))[:80]} was {how}")
    return version


def _made(version: int) -> sqlite3.Connection:
    """An empty database of that version, in memory."""
    empty = sqlite3.connect(":memory:", isolation_level=None)
    for number, step in sorted(STEPS.items()):
        if number <= version:
            empty.executescript(step)
    return empty


def _objects(connection: sqlite3.Connection) -> dict[tuple[str, str], tuple[str, list[list[str]]]]:
    """(kind, name) to (table, parts of the SQL) of all that somebody wrote into a schema."""
    rows = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {
        (kind, name): (table, _parts(str(sql)))
        for kind, name, table, sql in rows
        if (kind, name) != ("table", "sqlite_sequence")
    }


def _parts(sql: str) -> list[list[str]]:
    """The words of a statement: its own, and those of each column of a table, in any order.

    A column that came by ALTER TABLE stands elsewhere than one that was there from the first.
    """
    tokens = [text or name or word for text, name, word in _TOKEN.findall(sql)]
    tokens = [token for token in tokens if token]  # a comment gives none
    if tokens[:2] != ["CREATE", "TABLE"] or ")" not in tokens:
        return [tokens]
    close = len(tokens) - tokens[::-1].index(")") - 1
    parts: list[list[str]] = [[]]
    depth = 0
    for token in tokens[:close]:
        depth += (token == "(") - (token == ")")
        if token == "," and depth == 1:
            parts.append([])
        else:
            parts[-1].append(token)
    return [*sorted(parts), tokens[close:]]


def migrate(connection: sqlite3.Connection) -> None:
    """Brings a database to the newest version, all or nothing of each step.

    Args:
        connection: In autocommit mode.

    Raises:
        ValueError: As ``check_version``.
    """
    version = check_version(connection)
    for number, step in sorted(STEPS.items()):
        if number <= version:
            continue
        try:
            connection.executescript(f"BEGIN IMMEDIATE; {step} PRAGMA user_version = {number}; COMMIT;")
        except sqlite3.Error:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            if check_version(connection) < number:  # else another process was quicker
                raise
