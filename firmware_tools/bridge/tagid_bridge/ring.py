"""A first-in-first-out byte buffer of fixed size; one of its sides may be an interrupt.

It allocates no memory during use, because an interrupt must not."""


class Ring:
    """Bytes in order; data that does not fit is rejected as a whole, so that no command is split."""

    def __init__(self, size):
        self._buffer = bytearray(size + 1)
        self._start = 0
        self._end = 0

    def __len__(self):
        length = self._end - self._start
        return length if length >= 0 else length + len(self._buffer)

    def free(self):
        """Free space, bytes."""
        return len(self._buffer) - 1 - len(self)

    def put(self, data):
        """Append all of `data`, or nothing and return False."""
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
        """Up to `limit` bytes from the front, without removing them."""
        count = min(limit, len(self))
        start = self._start
        first = min(count, len(self._buffer) - start)
        data = bytes(self._buffer[start : start + first])
        if first < count:
            data += bytes(self._buffer[: count - first])
        return data

    def drop(self, count):
        self._start = (self._start + min(count, len(self))) % len(self._buffer)

    def clear(self):
        """Forgets everything."""
        self._start = self._end
