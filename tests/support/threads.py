"""Functions called in another thread."""

import threading

import sonar_gl as sg


def in_another_thread(function) -> list[str]:
    """Call a function in another thread. Return the text of the Error that it raises, or [].

    Any other exception is raised again in this thread.
    """
    messages, others = [], []

    def work():
        try:
            function()
        except sg.Error as why:
            messages.append(str(why))
        except BaseException as why:
            others.append(why)

    thread = threading.Thread(target=work, name="other")
    thread.start()
    thread.join()
    for why in others:
        raise why
    return messages
