// SPDX-License-Identifier: MIT OR Apache-2.0
// Cyclone DDS through its C interface: an array of octets, listeners, three configurations.
//   default  as it comes: UDP over the loopback
//   tuned    as its manual advises for large messages: packets of up to 64 KiB, larger socket buffers, on the loopback alone
//   shared-memory  through iceoryx, with loans on both sides; needs its daemon RouDi
#include "exchange.hpp"

#include <dds/dds.h>
#include <dds/ddsc/dds_loan_api.h>
#include <dds/version.h>

using exchange::Job;
using exchange::Stamp;

namespace {

dds_entity_t made(dds_entity_t entity, const char* what) {
    if (entity < 0) throw std::runtime_error(std::string("cannot make the ") + what + ": " + dds_strretcode(-entity));
    return entity;
}

bool is_shared(const Job& job) { return job.has_mode("shared-memory"); }

class Participant {
  public:
    explicit Participant(const Job& job) : job_(job) {
        const char* config = job.has_mode("tuned")
            ? "<General><Interfaces><NetworkInterface name=\"lo\" multicast=\"true\"/></Interfaces>"
              "<MaxMessageSize>65500B</MaxMessageSize></General>"
              "<Internal><SocketReceiveBufferSize min=\"default\" max=\"16MB\"/></Internal>"
              "<Tracing><Verbosity>none</Verbosity></Tracing>"
            : "<Tracing><Verbosity>none</Verbosity></Tracing>";
        if (is_shared(job)) config = "<SharedMemory><Enable>true</Enable><LogLevel>fatal</LogLevel></SharedMemory>"
                                     "<Tracing><Verbosity>none</Verbosity></Tracing>";
        made(dds_create_domain(job.domain, config), "domain");
        participant_ = made(dds_create_participant(job.domain, nullptr, nullptr), "participant");
        ops_ = {DDS_OP_ADR | DDS_OP_TYPE_ARR | DDS_OP_SUBTYPE_1BY, 0, uint32_t(job.payload_bytes), DDS_OP_RTS};
        type_ = "Bytes" + std::to_string(job.payload_bytes);
    }
    ~Participant() { dds_delete(participant_); }

    dds_entity_t writer(const std::string& name) {
        return made(dds_create_writer(participant_, topic(name), qos().get(), nullptr), "writer");
    }
    dds_entity_t reader(const std::string& name, dds_listener_t* listener) {
        return made(dds_create_reader(participant_, topic(name), qos().get(), listener), "reader");
    }

  private:
    std::unique_ptr<dds_qos_t, void (*)(dds_qos_t*)> qos() {
        std::unique_ptr<dds_qos_t, void (*)(dds_qos_t*)> qos(dds_create_qos(), dds_delete_qos);
        dds_qset_reliability(qos.get(), DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
        // Through iceoryx it has no more than keep last.
        if (job_.is_stream && !is_shared(job_)) {
            dds_qset_history(qos.get(), DDS_HISTORY_KEEP_ALL, 0);
            dds_qset_resource_limits(qos.get(), job_.depth, 1, job_.depth);
        } else {
            dds_qset_history(qos.get(), DDS_HISTORY_KEEP_LAST, job_.depth);
        }
        return qos;
    }
    dds_entity_t topic(const std::string& name) {
        dds_entity_t& topic = topics_[name];
        if (topic == 0) {
            const dds_topic_descriptor_t descriptor = {uint32_t(job_.payload_bytes), 1, DDS_TOPIC_FIXED_SIZE, 0,
                                                       type_.c_str(), nullptr, 2, ops_.data(), "", {}, {}, 0};
            topic = made(dds_create_topic(participant_, &descriptor, name.c_str(), nullptr, nullptr), "topic");
        }
        return topic;
    }
    const Job& job_;
    dds_entity_t participant_ = 0;
    std::vector<uint32_t> ops_;
    std::string type_;
    std::map<std::string, dds_entity_t> topics_;
};

class Outlet {
  public:
    Outlet(Participant& participant, const Job& job, const std::string& topic)
        : job_(job), writer_(participant.writer(topic)), sample_(is_shared(job) ? 0 : job.payload_bytes) {}
    // Refused after a second without room.
    bool send(Stamp stamp) {
        void* sample = sample_.data();
        if (is_shared(job_)) made(dds_loan_sample(writer_, &sample), "loan");
        exchange::exchange_write(stamp, sample, job_.payload_bytes, job_.whole);
        return dds_write(writer_, sample) == DDS_RETCODE_OK;
    }

  private:
    const Job& job_;
    dds_entity_t writer_;
    std::vector<uint8_t> sample_;
};

class Input {
  public:
    Input(Participant& participant, const Job& job, const std::string& topic, std::function<void(Stamp)> then)
        : job_(job), then_(std::move(then)) {
        auto* listener = dds_create_listener(this);
        dds_lset_data_available(listener, [](dds_entity_t reader, void* self) { static_cast<Input*>(self)->take(reader); });
        reader_ = participant.reader(topic, listener);
        dds_delete_listener(listener);
    }
    void close() { dds_set_listener(reader_, nullptr); }

  private:
    void take(dds_entity_t reader) {
        for (;;) {
            void* sample[1] = {nullptr};
            dds_sample_info_t info[1];
            int32_t count = dds_take(reader, sample, info, 1, 1);
            if (count <= 0) return;
            bool is_valid = info[0].valid_data;
            Stamp stamp{};
            bool is_whole = is_valid && exchange::exchange_read(sample[0], job_.payload_bytes, job_.whole, &stamp);
            dds_return_loan(reader, sample, count);
            if (is_valid && !is_whole) exchange::damaged(stamp.number);
            if (is_valid) then_(stamp);
        }
    }
    const Job& job_;
    std::function<void(Stamp)> then_;
    dds_entity_t reader_ = 0;
};

}  // namespace

int main() {
    return exchange::play<Participant, Outlet, Input>("cyclonedds", "Cyclone DDS " DDS_VERSION);
}
