from recon_cli.sfm.pairs import exhaustive, sequential


def names(count):
    return [f"{index:06d}.png" for index in range(count)]


def test_all_pairs_of_a_hundred_images_are_4950():
    assert len(exhaustive(names(100))) == 4950


def test_a_pair_is_named_in_order():
    assert exhaustive(["b", "c", "a"]) == {("a", "b"), ("a", "c"), ("b", "c")}


def test_sequential_pairs_are_neighbours_and_powers_of_two():
    # 20 images: 19 + 18 + ... + 10 neighbours at 1 to 10, and 4 pairs that are 16 apart.
    found = sequential(names(20))
    assert len(found) == sum(range(10, 20)) + 4
    assert ("000000.png", "000016.png") in found
    assert ("000000.png", "000011.png") not in found


def test_two_images_are_one_pair():
    assert sequential(["b", "a"]) == exhaustive(["a", "b"]) == {("a", "b")}
