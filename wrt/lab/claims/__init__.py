"""Published claims about ray tracing hardware, repeated with exact counts: `python -m wrt bench claims`."""
