"""Headless Chromium for tests of pages; a test is skipped where none is installed."""

import contextlib
import os
import shutil
import socket
from unittest import mock

import pytest


ARGUMENTS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=900,500"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--test-type",  # no bars above the page, which come and go and change its height
)
BUTTON = "//button[normalize-space()='{}']"


def free_port():
    """Return a port of this computer that is free."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


@contextlib.contextmanager
def open_browser():
    """Yield Selenium's driver of a new browser."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs Selenium")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs Chromium (Debian's package chromium)")
    chromedriver = shutil.which("chromedriver")
    if chromedriver is None:
        pytest.skip("needs chromedriver (Debian's package chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ARGUMENTS:
        options.add_argument(argument)
    options.add_experimental_option("excludeSwitches", ["enable-automation"])
    with mock.patch.dict(os.environ, {"no_proxy": "localhost"}):  # the driver listens there
        driver = webdriver.Chrome(options, webdriver.ChromeService(chromedriver))
    try:
        yield driver
    finally:
        driver.quit()


def wait(driver, script, *arguments, seconds=30):
    """Run a script until it returns something true, and return that."""
    from selenium.webdriver.support.wait import WebDriverWait

    return WebDriverWait(driver, seconds, poll_frequency=0.1).until(
        lambda driver: driver.execute_script(script, *arguments), f"still nothing: {script}"
    )


def press(driver, text):
    """Click the button with this text; a panel that is still opening may move or cover it."""
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver.support.wait import WebDriverWait

    def click(driver):
        driver.find_element("xpath", BUTTON.format(text)).click()
        return True

    WebDriverWait(driver, 30, ignored_exceptions=(WebDriverException,)).until(click)


def click_in_the_middle(driver):
    """Click in the middle of the window."""
    from selenium.webdriver import ActionChains

    page = driver.find_element("tag name", "body")
    ActionChains(driver).move_to_element(page).pause(0.2).click().perform()
