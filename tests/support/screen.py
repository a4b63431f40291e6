"""A terminal as a stream, and what it shows."""

import io
import re


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """Return what the terminal shows, with the control sequences in use."""
        rows, y, x = [""], 0, 0
        for end, command, control, text in re.findall(r"\x1b\[([\d;?]*)([A-Za-z])|([\r\n])|([^\x1b\r\n]+)", self.getvalue()):
            if command == "A":
                y -= int(end or 1)
            elif command == "K":
                rows[y] = ""
            elif control == "\r":
                x = 0
            elif control == "\n":
                y, x = y + 1, 0
                rows += [""] * (y == len(rows))
            elif text:
                rows[y] = rows[y][:x].ljust(x) + text
                x += len(text)
            else:
                assert command in "mhl", command  # colours, and whether the cursor is visible
        return [row.rstrip() for row in rows if row.strip()]
