# SPDX-License-Identifier: Apache-2.0
"""HTTP whose every answer is what was asked for, or is refused.

Imported where a URL of the web is opened only: it needs the extra `cloud`.
"""

import re
from collections.abc import AsyncIterator
from typing import Any, Final

import aiohttp
from fsspec.implementations.http import HTTPFileSystem

#: Waiting for a connection, for the next bytes of an answer, and for all of them: a server that
#: sends a byte now and then would keep one for ever.
_TIMEOUT: Final = aiohttp.ClientTimeout(total=4 * 3600, sock_connect=15, sock_read=30)
_PIECE: Final = 1 << 20


class UnaskedError(OSError):
    """An answer is not what was asked for."""


class StrictHTTPFileSystem(HTTPFileSystem):  # type: ignore[misc]  # fsspec is not typed
    """fsspec's, with each partial answer held against its request (RFC 9110, section 14).

    A server that sends the whole file where a part is asked for raises `NotImplementedError`,
    before anything of it is read.
    """

    #: fsspec would hand out the first one again, with its session and what it had been given.
    cachable = False

    def __init__(self) -> None:
        super().__init__(client_kwargs={"timeout": _TIMEOUT}, use_listings_cache=False)

    def ukey(self, path: str) -> str:
        """What changes when the file does: its tag, time and size, as the server tells."""
        info = self.info(path)
        return "|".join(str(info.get(key, "")) for key in ("ETag", "Last-Modified", "size"))

    async def _cat_file(
        self, url: str, start: int | None = None, end: int | None = None, **kwargs: Any
    ) -> bytes:
        if start is None or end is None or start >= end:
            return bytes(await super()._cat_file(url, start=start, end=end, **kwargs))
        session = await self.set_session()
        headers = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        async with session.get(self.encode_url(url), headers=headers) as response:
            self._raise_not_found_for_status(response, url)
            if response.status == 200:
                raise NotImplementedError(f"{url}: a server that gives no parts of a file")
            place = re.match(r"bytes (\d+)-(\d+)/", response.headers.get("Content-Range", ""))
            span = (int(place[1]), int(place[2]) + 1) if place else None
            if response.status != 206 or span != (start, end):
                given = "no place" if span is None else f"bytes {span[0]:,} to {span[1]:,}"
                raise UnaskedError(
                    f"bytes {start:,} to {end:,} asked for, {given} answered "
                    f"(status {response.status})"
                )
            content = b"".join([piece async for piece in _pieces(response, end - start)])
        if len(content) != end - start:
            raise UnaskedError(f"{end - start:,} bytes asked for, {len(content):,} answered")
        return content

    async def _get_file(self, rpath: str, lpath: str, **_: Any) -> None:
        """Copy a whole file, of the size that the server announces, or, without one, to its end."""
        size, session = (await self._info(rpath))["size"], await self.set_session()
        headers = {"Accept-Encoding": "identity"}
        async with session.get(self.encode_url(rpath), headers=headers) as response:
            self._raise_not_found_for_status(response, rpath)
            with open(lpath, "wb") as file:  # nothing else waits for this loop
                async for piece in _pieces(response, size):
                    file.write(piece)
                written = file.tell()
        if size is not None and written != size:
            raise UnaskedError(f"{size:,} bytes announced and asked for, {written:,} answered")


async def _pieces(response: aiohttp.ClientResponse, size: int | None) -> AsyncIterator[bytes]:
    """An answer, piece by piece, and no more of it than was asked for."""
    total = 0
    async for piece in response.content.iter_chunked(_PIECE):
        total += len(piece)
        if size is not None and total > size:
            raise UnaskedError(f"{size:,} bytes asked for, more answered")
        yield piece
