"""The same tables for a terminal, Markdown, LaTeX and CSV."""
