"""From photographs or a video to a capture: poses by structure from motion."""
