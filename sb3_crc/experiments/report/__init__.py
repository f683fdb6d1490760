"""One page about runs, for people to look at: tables, interactive curves, settings, films, instruments."""
