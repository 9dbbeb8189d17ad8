"""Which tokens are good for what, and which texts are tokens."""

from pathlib import Path

import pytest

from edgegrasp_service.errors import InvalidSettings, PermissionDenied, Unauthenticated
from edgegrasp_service.security import Tokens, load_tokens
from edgegrasp_service.settings import Settings

USER = "user-token-0123456789"
SECOND = "second-token-0123456789"
ADMIN = "admin-token-0123456789"
WRONG = "wrong-token-0123456789"


@pytest.mark.parametrize(
    ("header", "admin", "error"),
    [
        (f"Bearer {USER}", False, None),
        (f"bearer  {SECOND} ", False, None),
        (f"Bearer {ADMIN}", False, None),
        (f"Bearer {ADMIN}", True, None),
        (f"Bearer {USER}", True, PermissionDenied),
        (f"Bearer {WRONG}", True, Unauthenticated),
        (None, True, Unauthenticated),
        (None, False, Unauthenticated),
        ("", False, Unauthenticated),
        ("Bearer", False, Unauthenticated),
        (f"Basic {USER}", False, Unauthenticated),
        (USER, False, Unauthenticated),
        ("Bearer \udcff\xff", False, Unauthenticated),
    ],
)
def test_check(
    header: str | None, admin: bool, error: type[Exception] | None, tmp_path: Path
) -> None:
    users, admins = tmp_path / "tokens", tmp_path / "admin_tokens"
    users.write_text(f"{USER}\n{SECOND}\n")
    admins.write_text(ADMIN)
    known = load_tokens(Settings(token_file=users, admin_token_file=admins))
    if error is None:
        known.check(header, admin=admin)
    else:
        with pytest.raises(error):
            known.check(header, admin=admin)


def test_without_tokens_all_but_administration_is_open() -> None:
    Tokens().check(None)
    with pytest.raises(PermissionDenied, match="SIGHUP"):
        Tokens().check(f"Bearer {ADMIN}", admin=True)


def test_tokens_have_names(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    file.write_text(f"# of the cell\narm-1:{USER}\n  {SECOND}\n")
    admins = tmp_path / "admins"
    admins.write_text(ADMIN)
    known = load_tokens(Settings(token_file=file, admin_token_file=admins))
    names = [known.check(f"Bearer {token}").name for token in (USER, SECOND, ADMIN)]
    assert names == ["arm-1", "token_file 2", "admin_token_file 1"]
    assert USER not in repr(vars(known))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("short\n", "got 5 letters as token 1"),
        (f"{USER}\ntwo words of enough letters\n", "token 2"),
        ("# none\n", "It holds no token"),
        (b"\xff\xfe", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, text: str | bytes | None, sentence: str) -> None:
    path = tmp_path / "tokens"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InvalidSettings) as caught:
        load_tokens(Settings(token_file=path))
    assert sentence in str(caught.value)
    assert "short" not in str(caught.value)
