"""Check whether a capture's poses, lenses and points fit its photographs."""
