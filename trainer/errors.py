"""The one error that is meant for the person at the keyboard."""


class UserError(Exception):
    """What was wrong, where, and what would be right, in one sentence.

    The command line prints it alone (no traceback) and exits with code 2; the page shows it as text.
    """
