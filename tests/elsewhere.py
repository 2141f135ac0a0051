"""Things done in another thread."""

import threading

import sonar_gl as sg


def in_another_thread(function) -> list[str]:
    """The Error that it raises there, if it does, as text; any other goes on here."""
    said, other = [], []

    def work():
        try:
            function()
        except sg.Error as why:
            said.append(str(why))
        except BaseException as why:
            other.append(why)

    thread = threading.Thread(target=work, name="other")
    thread.start()
    thread.join()
    for why in other:
        raise why
    return said
