"""Topics, whatever carries them."""

import re

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.ros import DdsTransport, ZenohTransport
from sonar_gl.ros.transport import Topic, ros_domain

# of ROS 2's own message, as `ros2 topic info -v` shows it
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_a_topic_of_a_known_type_has_its_hash_and_definition():
    found = Topic.of_type("/chatter", "std_msgs/msg/String", latched=True, depth=7)
    definition = found.definition
    assert found == Topic(
        "/chatter", "std_msgs/msg/String", STRING_HASH, definition, reliable=True, latched=True, depth=7
    )
    assert definition.split() == ["string", "data"]


@pytest.mark.parametrize("msgtype", ["my_msgs/msg/Thing", "std_msgs/String", 3])
def test_an_unknown_type_is_told_in_a_sentence(msgtype):
    why = f"must be one of ROS 2 Humble or of a ping, such as 'sensor_msgs/msg/Image' (got {msgtype!r})"
    with pytest.raises(Error, match=re.escape(why)):
        Topic.of_type("/chatter", msgtype)


@pytest.mark.parametrize(("text", "domain"), [(None, 0), ("", 0), (" 7 ", 7), ("007", 7), ("232", 232)])
def test_the_domain_is_that_of_ros_unless_it_is_given(monkeypatch, text, domain):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    if text is not None:
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
    assert ros_domain() == domain
    assert ros_domain(5) == 5


@pytest.mark.parametrize("text", ["zero", "233", "-1", "1.0", "0000000000001", "\u0663"])
@pytest.mark.parametrize("what", [ros_domain, ZenohTransport, DdsTransport])
def test_a_domain_of_ros_that_is_none_is_told(monkeypatch, text, what):
    """The last is a digit of Arabic, which Python takes for one."""
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(Error, match=r"ROS_DOMAIN_ID must be a whole number in 0\.\.232"):
        what()
