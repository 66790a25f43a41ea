"""What every verb asks of the words of its command line."""

from collections.abc import Sequence

from phd_exp.records.errors import UNPRINTABLE, ConfigError, one_line


def require_visible(words: Sequence[str]) -> None:
    """Raise ConfigError for a word that a message could not repeat on its line."""
    for word in words:
        if UNPRINTABLE.search(word):
            raise ConfigError(
                f"{one_line(word)}: holds control characters; expected KEY=VALUE in visible ones"
            )
