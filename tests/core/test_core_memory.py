from pipeline.core.compute import Newest


def test_what_was_asked_for_last_is_remembered_and_the_rest_made_anew() -> None:
    made: list[int] = []

    def make(number: int) -> list[int]:
        made.append(number)
        return [number]

    newest = Newest[list[int]](2)
    first = newest.recall(1, lambda: make(1))
    newest.recall(2, lambda: make(2))
    assert newest.recall(1, lambda: make(1)) is first
    newest.recall(3, lambda: make(3))
    assert newest.recall(1, lambda: make(1)) is first
    newest.recall(2, lambda: make(2))
    assert made == [1, 2, 3, 2]
