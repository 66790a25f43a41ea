"""What is on disk, as plain records: data sets and runs. No torch here, so that every other programme may read it."""
