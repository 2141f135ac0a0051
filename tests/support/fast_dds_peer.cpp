// A program of another DDS vendor: it reads the messages of a topic into a file, or writes those of a file.
//
//   fast_dds_peer read DOMAIN TOPIC TYPE SECONDS FILE COUNT [latched]
//   fast_dds_peer write DOMAIN TOPIC TYPE SECONDS FILE GAP_MS
//
// The file holds, for each message, its length (uint32) and its bytes with the header of four, whatever these are.
// It prints "ready" when its topic is known. `read` ends after COUNT messages; `write` waits for a reader, waits GAP_MS
// after each message, and ends when the reader has confirmed all. Both end after SECONDS, and print the number of
// messages. QoS is that of ROS 2 nodes: reliable, and transient local if latched; the type has no description.
// Built with Debian's libfastrtps-dev: g++ fast_dds_peer.cpp -lfastrtps -lfastcdr
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using std::chrono::milliseconds;

using Message = std::vector<unsigned char>;
using Clock = std::chrono::steady_clock;

class AnyType : public TopicDataType {
 public:
  explicit AnyType(const char* name) {
    setName(name);
    m_typeSize = 1 << 20;
    m_isGetKeyDefined = false;
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    const auto& message = *static_cast<Message*>(data);
    std::memcpy(payload->data, message.data(), message.size());
    payload->length = static_cast<uint32_t>(message.size());
    return true;
  }
  bool deserialize(SerializedPayload_t* payload, void* message) override {
    static_cast<Message*>(message)->assign(payload->data, payload->data + payload->length);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void* message) override {
    return [message] { return static_cast<uint32_t>(static_cast<Message*>(message)->size()); };
  }
  void* createData() override { return new Message; }
  void deleteData(void* message) override { delete static_cast<Message*>(message); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

static int read_messages(DomainParticipant* participant, Topic* topic, Clock::time_point end, std::FILE* file, int count,
                         bool latched) {
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  qos.durability().kind = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
  qos.history().depth = 200;
  qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos);
  std::puts("ready");
  std::fflush(stdout);
  Message message;
  SampleInfo info;
  int received = 0;
  while (received < count && Clock::now() < end) {
    while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      const auto length = static_cast<uint32_t>(message.size());
      std::fwrite(&length, sizeof length, 1, file);
      std::fwrite(message.data(), 1, message.size(), file);
      received++;
    }
    std::this_thread::sleep_for(milliseconds(2));
  }
  return received;
}

static int write_messages(DomainParticipant* participant, Topic* topic, Clock::time_point end, std::FILE* file,
                          int gap_ms) {
  DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
  qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  qos.reliability().max_blocking_time = eprosima::fastrtps::Duration_t(60, 0);
  qos.reliable_writer_qos().times.heartbeatPeriod = eprosima::fastrtps::Duration_t(0, 20'000'000);
  qos.history().kind = KEEP_ALL_HISTORY_QOS;
  qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  auto* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
  std::puts("ready");
  std::fflush(stdout);
  PublicationMatchedStatus matched;
  do {
    std::this_thread::sleep_for(milliseconds(2));
    writer->get_publication_matched_status(matched);
  } while (matched.current_count == 0 && Clock::now() < end);
  std::this_thread::sleep_for(milliseconds(500));  // the reader learns of this writer
  Message message;
  uint32_t length;
  int written = 0;
  while (Clock::now() < end && std::fread(&length, sizeof length, 1, file) == 1) {
    message.resize(length);
    if (std::fread(message.data(), 1, length, file) != length) break;
    written += writer->write(&message);
    if (gap_ms > 0) std::this_thread::sleep_for(milliseconds(gap_ms));
  }
  writer->wait_for_acknowledgments(eprosima::fastrtps::Duration_t(60, 0));
  return written;
}

int main(int argc, char** argv) {
  if (argc < 8) return 2;
  const bool reads = std::string(argv[1]) == "read";
  const auto end = Clock::now() + std::chrono::seconds(std::atoi(argv[5]));
  auto* participant =
      DomainParticipantFactory::get_instance()->create_participant(std::atoi(argv[2]), PARTICIPANT_QOS_DEFAULT);
  TypeSupport type(new AnyType(argv[4]));
  type.register_type(participant);
  auto* topic = participant->create_topic(argv[3], type.get_type_name(), TOPIC_QOS_DEFAULT);
  std::FILE* file = std::fopen(argv[6], reads ? "wb" : "rb");
  if (topic == nullptr || file == nullptr) return 1;
  const int number = std::atoi(argv[7]);
  const int done = reads ? read_messages(participant, topic, end, file, number, argc > 8)
                         : write_messages(participant, topic, end, file, number);
  std::fclose(file);
  std::printf("%d\n", done);
  std::fflush(stdout);
  std::_Exit(0);  // as if the program were killed: the participant says no farewell
}
