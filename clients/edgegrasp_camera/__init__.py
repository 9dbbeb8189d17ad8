"""Data of depth cameras: depth images, PointCloud2, cloud files and poses; needs only numpy."""


class EdgeGraspError(Exception):
    """Base of every error that the project raises on purpose, except the client's."""

    def __reduce__(self) -> tuple[object, ...]:  # `args` are not the arguments of `__init__`
        return Exception.__new__, (type(self), *self.args), vars(self)


class InvalidRequest(EdgeGraspError):  # noqa: N818
    """The caller's input is wrong.

    Args:
        field: Name of the request field, as it is spelled on the wire (`cloud`, `options.seed`).
        value: What was received, shortened for printing.
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
    """The data's format is not supported."""
