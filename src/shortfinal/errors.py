"""The one exception for wrong input."""


class InputError(ValueError):
    """The input is wrong; the message is one line that names what, where, and how to mend it.

    The command line prints it and exits with status 2; a library user catches it as a ValueError.
    """
