// Grasps of a depth image, from a running server.
//
// usage: detect DEPTH WIDTH HEIGHT FX FY CX CY [ADDRESS]
//
// DEPTH is a file of 16-bit little-endian millimetres, row by row, 0 where there is no reading: the
// output of a depth camera, 614 kB at 640 x 480, where points would take 3.7 MB. ADDRESS is
// host:port, dns:///name:port, or unix:/folder/grpc.sock of a server on this machine.

#include <chrono>
#include <fstream>
#include <iostream>
#include <iterator>
#include <string>

#include <grpcpp/grpcpp.h>

#include "edgegrasp/v1/grasp.grpc.pb.h"

// Use all servers of a name in turn, and retry if one is unavailable or has lost the request.
constexpr char kPolicy[] = R"({
  "loadBalancingConfig": [{"round_robin": {}}],
  "methodConfig": [{
    "name": [{}],
    "retryPolicy": {"maxAttempts": 5, "initialBackoff": "0.1s", "maxBackoff": "2s",
                    "backoffMultiplier": 2, "retryableStatusCodes": ["UNAVAILABLE"]}
  }]
})";

int main(int argc, char** argv) {
  if (argc < 8 || argc > 9) {
    std::cerr << "usage: detect DEPTH WIDTH HEIGHT FX FY CX CY [ADDRESS]\n";
    return 2;
  }
  std::ifstream file(argv[1], std::ios::binary);
  if (!file) {
    std::cerr << "error: cannot read " << argv[1] << "\n";
    return 1;
  }

  edgegrasp::v1::DetectGraspsRequest request;
  auto* image = request.add_depth_images();
  auto* depth = image->mutable_depth();
  depth->set_width(std::stoi(argv[2]));
  depth->set_height(std::stoi(argv[3]));
  depth->set_encoding("16UC1");
  depth->mutable_data()->assign(std::istreambuf_iterator<char>(file), {});
  auto* intrinsics = image->mutable_intrinsics();
  intrinsics->set_fx(std::stod(argv[4]));
  intrinsics->set_fy(std::stod(argv[5]));
  intrinsics->set_cx(std::stod(argv[6]));
  intrinsics->set_cy(std::stod(argv[7]));
  request.mutable_options()->set_top_k(5);

  grpc::ChannelArguments arguments;
  arguments.SetServiceConfigJSON(kPolicy);
  arguments.SetMaxReceiveMessageSize(-1);
  auto channel = grpc::CreateCustomChannel(argc == 9 ? argv[8] : "127.0.0.1:50051",
                                           grpc::InsecureChannelCredentials(), arguments);
  auto stub = edgegrasp::v1::GraspService::NewStub(channel);

  grpc::ClientContext context;  // the server also stops at the deadline
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(30));
  edgegrasp::v1::DetectGraspsResponse answer;
  const grpc::Status status = stub->DetectGrasps(&context, request, &answer);
  if (!status.ok()) {
    std::cerr << "error " << status.error_code() << ": " << status.error_message() << "\n";
    return 1;
  }

  for (const auto& warning : answer.warnings()) std::cout << "warning: " << warning << "\n";
  for (const auto& grasp : answer.grasps()) {
    std::cout << "score " << grasp.score() << ", T_cloud_tcp";
    for (double number : grasp.t_cloud_tcp()) std::cout << ' ' << number;
    std::cout << "\n";
  }
  return 0;
}
