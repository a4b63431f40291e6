import pytest

from sextant.services.mapper.config import Settings


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"cells": 1024}, "at most 441397 cells of the map, which a message of mapper/terrain has room for, expected"),
        ({"cells": 8, "cells_y": 10**6}, "cells of the map"),
        ({"passage_cells": 10**6}, "at most 123241 passage_cells, which a message of mapper/passage has room for, expected"),
    ],
)
def test_map_too_large_for_its_message_is_refused(settings: dict[str, int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Settings(**settings)


def test_the_largest_map_is_accepted() -> None:
    assert Settings(cells=664).shape == (664, 664)
