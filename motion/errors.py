"""The one error type for bad input, so that every command can answer it with one clear line."""


class InputError(ValueError):
    """Something that the user gave is wrong. The message names the file or key and the remedy, on one line."""
