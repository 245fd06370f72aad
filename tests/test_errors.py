from recon_cli.errors import list_names


def test_a_short_list_is_given_in_full_and_a_long_one_with_the_number_of_the_others():
    assert list_names(["a", "b"]) == "a, b"
    assert list_names(["a", "b", "c"], most=2) == "a, b and 1 more"
