"""What a depth camera gives: depth images, PointCloud2, files of clouds, and poses; numpy alone."""


class EdgeGraspError(Exception):
    """Base of every error that the project raises on purpose, but for the client's."""


class InvalidRequest(EdgeGraspError):  # noqa: N818
    """The caller's input is wrong.

    Args:
        field: Name of the request field, as it is spelled on the wire (`cloud`, `options.seed`).
        value: What was received, short enough to print.
        fix: What to send instead, as an imperative sentence.
    """

    def __init__(self, field: str, value: str, fix: str) -> None:
        self.field = field
        self.value = value
        self.fix = fix
        super().__init__(f"{field}: got {value}. {fix}")


class PayloadTooLarge(InvalidRequest):
    """A body or a cloud is over the limits."""


class UnsupportedMediaType(InvalidRequest):
    """Data is in a format that there is no reader for."""
