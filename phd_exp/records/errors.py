"""The errors a user can mend: each is one line that says what, where, what was expected and what to do."""


class UserError(Exception):
    """Something the user asked for cannot be done as asked; the command line prints it without a traceback."""


class ConfigError(UserError):
    """A configuration that does not make sense: a key, its value, and what was expected instead."""


class RunError(UserError):
    """A run folder that cannot be used: held by another process, made by another configuration, or broken."""
