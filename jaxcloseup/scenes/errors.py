"""What can be wrong with a capture. Every message is one sentence that says what to do."""


class SceneError(ValueError):
    """A scene that cannot be loaded."""


class SceneWarning(UserWarning):
    """A scene that was loaded, though something about it may not be what its owner meant."""


class UnknownKeyWarning(SceneWarning):
    """A file holds fields that nothing here reads."""


class ImageSizeWarning(SceneWarning):
    """Photographs are not of the size their file gives."""


class NearFarWarning(SceneWarning):
    """The depth range was estimated."""


class DuplicateFileWarning(SceneWarning):
    """One photograph is listed more than once."""


class PointsWarning(SceneWarning):
    """Some of the initial points were dropped."""
