// Reads a recording with Foxglove's Go library for MCAP and prints what it found as JSON.
package main

import (
	"crypto/sha256"
	"encoding/hex"
	"encoding/json"
	"errors"
	"fmt"
	"io"
	"os"

	"github.com/foxglove/mcap/go/mcap"
)

type topic struct {
	Type     string `json:"type"`
	Encoding string `json:"encoding"`
	Messages int    `json:"messages"`
	Digest   string `json:"digest"` // SHA-256 of all payloads in the order of the file
}

type found struct {
	Profile     string                       `json:"profile"`
	Library     string                       `json:"library"`
	Messages    uint64                       `json:"messages"`
	Topics      map[string]*topic            `json:"topics"`
	Metadata    map[string]map[string]string `json:"metadata"`
	Attachments map[string]string            `json:"attachments"` // SHA-256 by name
}

func main() {
	if err := run(os.Args[1]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}

func run(path string) error {
	file, err := os.Open(path)
	if err != nil {
		return err
	}
	defer file.Close()
	reader, err := mcap.NewReader(file)
	if err != nil {
		return err
	}
	defer reader.Close()
	info, err := reader.Info()
	if err != nil {
		return err
	}
	out := found{
		Profile: reader.Header().Profile, Library: reader.Header().Library, Messages: info.Statistics.MessageCount,
		Topics: map[string]*topic{}, Metadata: map[string]map[string]string{}, Attachments: map[string]string{},
	}
	if err := readMessages(reader, &out); err != nil {
		return err
	}
	for _, index := range info.MetadataIndexes {
		record, err := reader.GetMetadata(index.Offset)
		if err != nil {
			return err
		}
		out.Metadata[record.Name] = record.Metadata
	}
	for _, index := range info.AttachmentIndexes {
		attachment, err := reader.GetAttachmentReader(index.Offset)
		if err != nil {
			return err
		}
		hash := sha256.New()
		if _, err := io.Copy(hash, attachment.Data()); err != nil {
			return err
		}
		out.Attachments[attachment.Name] = hex.EncodeToString(hash.Sum(nil))
	}
	return json.NewEncoder(os.Stdout).Encode(out)
}

func readMessages(reader *mcap.Reader, out *found) error {
	messages, err := reader.Messages(mcap.InOrder(mcap.FileOrder))
	if err != nil {
		return err
	}
	hashes := map[string]interface {
		io.Writer
		Sum([]byte) []byte
	}{}
	for {
		schema, channel, message, err := messages.NextInto(nil)
		if errors.Is(err, io.EOF) {
			break
		}
		if err != nil {
			return err
		}
		name := channel.Topic
		if out.Topics[name] == nil {
			out.Topics[name] = &topic{Type: schema.Name, Encoding: schema.Encoding}
			hashes[name] = sha256.New()
		}
		out.Topics[name].Messages++
		hashes[name].Write(message.Data)
	}
	for name, hash := range hashes {
		out.Topics[name].Digest = hex.EncodeToString(hash.Sum(nil))
	}
	return nil
}
