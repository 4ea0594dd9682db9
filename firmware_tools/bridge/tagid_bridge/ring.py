"""A first-in-first-out buffer of bytes with a fixed size; one side of it may be an interrupt.

It takes no memory while it works, because an interrupt must not."""


class Ring:
    """Bytes in order; what does not fit is refused whole, so that no command is ever cut in two."""

    def __init__(self, size):
        self._buffer = bytearray(size + 1)
        self._start = 0
        self._end = 0

    def __len__(self):
        length = self._end - self._start
        return length if length >= 0 else length + len(self._buffer)

    def free(self):
        """How many bytes still fit."""
        return len(self._buffer) - 1 - len(self)

    def put(self, data):
        """Appends all of `data`, or nothing and returns False."""
        count = len(data)
        if count > self.free():
            return False
        size = len(self._buffer)
        end = self._end
        first = min(count, size - end)
        self._buffer[end : end + first] = data[:first]
        if first < count:
            self._buffer[: count - first] = data[first:]
        self._end = (end + count) % size
        return True

    def peek(self, limit):
        """Up to `limit` bytes from the front, which stay."""
        count = min(limit, len(self))
        start = self._start
        first = min(count, len(self._buffer) - start)
        data = bytes(self._buffer[start : start + first])
        if first < count:
            data += bytes(self._buffer[: count - first])
        return data

    def drop(self, count):
        """Takes `count` bytes off the front."""
        self._start = (self._start + min(count, len(self))) % len(self._buffer)

    def clear(self):
        """Forgets everything."""
        self._start = self._end
