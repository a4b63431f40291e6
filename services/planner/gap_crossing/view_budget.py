"""Budget of views from one stop: how many, and how much each must reveal."""

from sextant.shared.wire.messages import PassageMap

_MAX_VIEWS = 3  # at one stop
_MIN_CELLS = 60  # minimum number of cells that a view must reveal
_MIN_CELLS_LATER = 20  # the same, after the search found no path because of unseen ground


class ViewBudget:
    """Number of views taken at one stop, and the least that another one must reveal."""

    def __init__(self) -> None:
        """Start with all views."""
        self.renew()

    def renew(self) -> None:
        """Start at another stop."""
        self._taken, self._min_cells = 0, _MIN_CELLS

    def exhaust(self) -> None:
        """Allow no further view: the known ground must suffice."""
        self._taken = _MAX_VIEWS

    def allows(self, map_: PassageMap) -> bool:
        """Return whether the view that a map proposes is worth taking."""
        return self._taken < _MAX_VIEWS and int(map_.next_view_cells.sum()) >= self._min_cells

    def spend(self) -> None:
        """Count a view."""
        self._taken += 1

    def accept_less(self) -> bool:
        """Accept views that reveal little; return whether this allows another one."""
        if self._min_cells <= _MIN_CELLS_LATER or self._taken >= _MAX_VIEWS:
            return False
        self._min_cells = _MIN_CELLS_LATER
        return True
