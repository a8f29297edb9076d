"""The one error that is the user's to mend."""


class UserError(Exception):
    """Something the user gave can't be used; the message says what, and what to do about it.

    The command line prints the message alone, without a traceback. Derive from this class for every
    error that a user can cause; any other exception that reaches the command line is a bug of ours.
    """
