"""The two ways a call can fail on purpose."""


class InputError(ValueError):
    """The input is wrong; the message is one line that names what, where, and how to mend it.

    The command line prints it and exits with status 2; a library user catches it as a ValueError.
    """


class JobError(RuntimeError):
    """The input was right, but the job failed; the command line exits with status 1."""
