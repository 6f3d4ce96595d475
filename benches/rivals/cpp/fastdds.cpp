// SPDX-License-Identifier: MIT OR Apache-2.0
// Fast DDS 2.14 as its manual advises: a hand-written type of plain bytes, listeners, three configurations.
//   default       builtin transports (shared memory and UDP) as they come
//   tuned         shared memory alone, its segment and messages large enough
//   data-sharing  the same, with data sharing and loans on both sides
#include "exchange.hpp"

#include <fastdds/dds/core/LoanableSequence.hpp>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/shared_mem/SharedMemTransportDescriptor.h>

namespace fdds = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastdds::rtps::SharedMemTransportDescriptor;
using exchange::Job;
using exchange::Stamp;

namespace {

// Bytes of a fixed number, whose memory is their CDR.
class Bytes : public fdds::TopicDataType {
  public:
    Bytes(size_t bytes, bool plain) : bytes_(uint32_t(bytes)), plain_(plain) {
        setName(("Bytes" + std::to_string(bytes)).c_str());
        m_typeSize = bytes_ + rtps::SerializedPayload_t::representation_header_size;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
        payload->encapsulation = CDR_LE;
        const uint8_t header[4] = {0, 1, 0, 0};
        memcpy(payload->data, header, 4);
        memcpy(payload->data + 4, data, bytes_);
        payload->length = bytes_ + 4;
        return true;
    }
    bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
        if (payload->length < bytes_ + 4) return false;
        memcpy(data, payload->data + 4, bytes_);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void*) override {
        return [bytes = bytes_] { return bytes + 4; };
    }
    void* createData() override { return new uint8_t[bytes_](); }
    void deleteData(void* data) override { delete[] static_cast<uint8_t*>(data); }
    bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
    bool is_bounded() const override { return true; }
    bool is_plain() const override { return plain_; }
    bool is_plain(fdds::DataRepresentationId_t) const override { return plain_; }
    bool construct_sample(void*) const override { return true; }

  private:
    uint32_t bytes_;
    bool plain_;
};

template <typename T>
T* there(T* made, const char* what) {
    if (made == nullptr) throw std::runtime_error(std::string("cannot make the ") + what);
    return made;
}

class Participant {
  public:
    explicit Participant(const Job& job) : job_(job), loans_(job.has_mode("data-sharing")) {
        auto* factory = fdds::DomainParticipantFactory::get_instance();
        fdds::DomainParticipantQos qos;
        if (!job.has_mode("default")) {
            qos.transport().use_builtin_transports = false;
            auto memory = std::make_shared<SharedMemTransportDescriptor>();
            // The manual: a segment that has room for several messages, and messages that need no fragments.
            memory->segment_size(64u << 20);
            memory->max_message_size(16u << 20);
            qos.transport().user_transports.push_back(memory);
        }
        participant_ = there(factory->create_participant(job.domain, qos), "participant");
        fdds::TypeSupport type(new Bytes(job.payload_bytes, loans_));
        type.register_type(participant_);
        type_ = type.get_type_name();
        publisher_ = there(participant_->create_publisher(fdds::PUBLISHER_QOS_DEFAULT), "publisher");
        subscriber_ = there(participant_->create_subscriber(fdds::SUBSCRIBER_QOS_DEFAULT), "subscriber");
    }
    ~Participant() {
        participant_->delete_contained_entities();
        fdds::DomainParticipantFactory::get_instance()->delete_participant(participant_);
    }
    fdds::DataWriter* writer(const std::string& name) {
        fdds::DataWriterQos qos;
        qos.reliability().kind = fdds::RELIABLE_RELIABILITY_QOS;
        qos.reliability().max_blocking_time = {1, 0};
        // As ROS 2 and all others here; its own default keeps messages for readers that come later.
        qos.durability().kind = fdds::VOLATILE_DURABILITY_QOS;
        set_history(qos.history(), qos.resource_limits());
        qos.endpoint().history_memory_policy = rtps::PREALLOCATED_MEMORY_MODE;
        qos.publish_mode().kind = fdds::SYNCHRONOUS_PUBLISH_MODE;
        if (loans_) qos.data_sharing().automatic();
        else qos.data_sharing().off();
        return there(publisher_->create_datawriter(topic(name), qos), "writer");
    }
    fdds::DataReader* reader(const std::string& name, fdds::DataReaderListener* listener) {
        fdds::DataReaderQos qos;
        qos.reliability().kind = fdds::RELIABLE_RELIABILITY_QOS;
        set_history(qos.history(), qos.resource_limits());
        qos.endpoint().history_memory_policy = rtps::PREALLOCATED_MEMORY_MODE;
        if (loans_) qos.data_sharing().automatic();
        else qos.data_sharing().off();
        return there(subscriber_->create_datareader(topic(name), qos, listener), "reader");
    }

  private:
    void set_history(fdds::HistoryQosPolicy& history, fdds::ResourceLimitsQosPolicy& limits) {
        int32_t depth = job_.depth;
        history.kind = job_.is_stream ? fdds::KEEP_ALL_HISTORY_QOS : fdds::KEEP_LAST_HISTORY_QOS;
        history.depth = depth;
        limits.max_samples = depth;
        limits.max_instances = 1;
        limits.max_samples_per_instance = depth;
        limits.allocated_samples = depth;
        // Of data sharing: slack for a reader that still looks at what it has taken.
        if (loans_) limits.extra_samples = depth;
    }
    fdds::Topic* topic(const std::string& name) {
        auto& topic = topics_[name];
        if (topic == nullptr) topic = there(participant_->create_topic(name, type_, fdds::TOPIC_QOS_DEFAULT), "topic");
        return topic;
    }
    const Job& job_;
    bool loans_;
    std::string type_;
    std::map<std::string, fdds::Topic*> topics_;
    fdds::DomainParticipant* participant_ = nullptr;
    fdds::Publisher* publisher_ = nullptr;
    fdds::Subscriber* subscriber_ = nullptr;
};

// Writes messages: into a loan, or into a sample of its own that is then written; says whether they were taken.
class Outlet {
  public:
    Outlet(Participant& participant, const Job& job, const std::string& topic)
        : job_(job), writer_(participant.writer(topic)), sample_(job.payload_bytes) {}
    bool send(Stamp stamp) {
        void* sample = sample_.data();
        if (job_.has_mode("data-sharing")) {
            // Refused while every sample of the history is out.
            while (writer_->loan_sample(sample) != eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
                if (exchange::exchange_stopped() && job_.is_round_trips) return false;
                sched_yield();
            }
        }
        exchange::exchange_write(stamp, sample, job_.payload_bytes, job_.whole);
        if (writer_->write(sample)) return true;
        if (job_.has_mode("data-sharing")) writer_->discard_loan(sample);
        return false;
    }

  private:
    const Job& job_;
    fdds::DataWriter* writer_;
    std::vector<uint8_t> sample_;
};

// Has what arrives read: in place, or in a sample of its own.
class Input : public fdds::DataReaderListener {
  public:
    Input(Participant& participant, const Job& job, const std::string& topic, std::function<void(Stamp)> then)
        : job_(job), then_(std::move(then)), sample_(job.payload_bytes), reader_(participant.reader(topic, this)) {}
    void close() { reader_->set_listener(nullptr); }
    void on_data_available(fdds::DataReader* reader) override {
        if (job_.has_mode("data-sharing")) {
            fdds::LoanableSequence<uint8_t> samples;
            fdds::SampleInfoSeq infos;
            // One at a time: what is taken counts as read, and its memory may be written again.
            while (reader->take(samples, infos, 1) == eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
                Stamp stamp{};
                bool is_valid = infos[0].valid_data;
                bool is_whole = is_valid && exchange::exchange_read(&samples[0], job_.payload_bytes, job_.whole, &stamp);
                // What was written over meanwhile is a loss: its number never arrives.
                is_valid = is_valid && reader->is_sample_valid(&samples[0], &infos[0]);
                reader->return_loan(samples, infos);
                if (is_valid && !is_whole) exchange::damaged(stamp.number);
                if (is_valid) then_(stamp);
            }
        } else {
            fdds::SampleInfo info;
            while (reader->take_next_sample(sample_.data(), &info) ==
                   eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
                Stamp stamp{};
                if (!info.valid_data) continue;
                if (!exchange::exchange_read(sample_.data(), job_.payload_bytes, job_.whole, &stamp))
                    exchange::damaged(stamp.number);
                then_(stamp);
            }
        }
    }

  private:
    const Job& job_;
    std::function<void(Stamp)> then_;
    std::vector<uint8_t> sample_;
    // Made last: it may call at once.
    fdds::DataReader* reader_;
};

}  // namespace

int main() {
    return exchange::play<Participant, Outlet, Input>("fastdds", "Fast DDS " FASTRTPS_VERSION_STR);
}
