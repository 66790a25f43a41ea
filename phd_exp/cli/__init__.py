"""The command line: one file a verb, each a thin coat on what the other folders do."""
