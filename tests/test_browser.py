"""The page that tests watch must notice what is wrong with it."""

from browser import WatchedPage
from facts import raises


def test_an_error_on_the_console_fails(page: WatchedPage) -> None:
    page.page.set_content("<script>console.error('lost')</script>")
    with raises(AssertionError, "lost"):
        page.assert_silent()


def test_a_script_that_throws_fails(page: WatchedPage) -> None:
    page.page.set_content("<script>throw new Error('broken')</script>")
    with raises(AssertionError, "broken"):
        page.assert_silent()


def test_a_page_that_asks_for_the_network_fails(page: WatchedPage) -> None:
    page.page.set_content("<img src='http://127.0.0.1:9/a.png'>")
    page.page.wait_for_timeout(100)
    with raises(AssertionError, "127.0.0.1:9"):
        page.assert_offline()


def test_a_quiet_page_with_webgl_passes(page: WatchedPage) -> None:
    page.page.set_content("<canvas></canvas>")
    assert page.page.evaluate("!!document.querySelector('canvas').getContext('webgl2')")
    page.assert_silent()
    page.assert_offline()
