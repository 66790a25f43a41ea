"""The report as a folder of pages: opens from the file system, without network or server."""
